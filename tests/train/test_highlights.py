"""Test that highlights of paint tell how bright lamps are, and how glossy paint is, on pictures that the renderer made."""

import math

import pytest
import torch

from refgs.model import cubemap
from refgs.model.surfels import raw_metallic
from refgs.render.mirrored_light import SIDE
from refgs.train.material import base_colors, gloss, highlights, metals
from tests.makers.training import copied, do, put, trainer

COMPARE, LEVEL = "compare highlights", "level base colours"
FIND, KEEP = "find glossy paint", "keep paint glossy"


@pytest.fixture(scope="module")
def start(sharp_ball, tmp_path_factory):
    """Make a small training. Tests copy it."""
    return trainer(sharp_ball, tmp_path_factory.mktemp("runs") / "start", total=400)


def shot(start, folder, metallic=0.002, roughness=0.3):
    """Copy a small training, whose photos then show its own surfels: grey paint under a lamp on one side. Also return the lamp's texels."""
    made = copied(start, folder)
    state = made.state
    put(made, albedo=torch.tensor([0.4, 0.4, 0.4]).logit(), roughness=torch.tensor(roughness).logit(), told=True)
    put(made, metallic=raw_metallic(metallic))
    state.part(metals.Metals).found = True
    state.told_light = torch.zeros(6 * SIDE**2, dtype=torch.bool)
    light = state.learned["environment"]
    lamps = cubemap.texel_directions(state.environment().resolution) @ torch.tensor([0.6, 0.0, 0.8]).double() > 0.97
    light.data.copy_(torch.where(lamps[:, None], 12.0, 0.2).log().expand(-1, 3))
    for view, photo in enumerate(state.photos):
        picture = state.render(photo.camera).color.clamp(0, 1)
        state.photos[view] = photo._replace(image=(255 * picture).round().to(torch.uint8), white=255)
    return state, lamps


def dim(state, lamps, factor):
    """Make lamps `factor` times as bright, and paint darker, so that it looks the same without its highlights."""
    light = state.learned["environment"].data
    area = cubemap.texel_solid_angles(state.environment().resolution)[:, None]
    before = float((light.exp() * area).sum())
    light[lamps] += math.log(factor)
    color = state.surfels().albedo.detach() * before / float((light.exp() * area).sum())
    state.learned["albedo"].data.copy_(color.clamp(0.02, 0.98).logit())


def compared(state):
    paint = metals._told_kinds(state)[1]
    return highlights.compare(state, base_colors.with_brighter_lamps(state, paint, highlights.BRIGHTER), 0)


def test_lamps_that_are_too_dim_or_too_bright_are_noticed(start, tmp_path):
    state, lamps = shot(start, tmp_path / "run")
    for factor, before in ((1.0, 1.0), (0.5, 1.0), (2.0, 0.5)):
        dim(state, lamps, factor / before)
        told = compared(state)
        assert told.log == pytest.approx(-math.log(factor), abs=0.35)
        assert (abs(told.log) < 0.03) == (factor == 1), "the photos are the renderer's own"


def test_other_roughness_is_not_taken_for_other_lamps(start, tmp_path):
    state, _ = shot(start, tmp_path / "run")
    for roughness in (0.25, 0.37):
        state.learned["roughness"].data.fill_(torch.tensor(roughness).logit())
        told = compared(state)
        assert abs(told.log) < 0.2, roughness


def test_lamps_are_balanced_until_highlights_agree(start, tmp_path):
    """Check that paint that photos have made too bright, under lamps that are too dim, becomes as it was in the photos."""
    state, lamps = shot(start, tmp_path / "run")
    power = state.learned["environment"].detach().exp()[lamps].mean()
    dim(state, lamps, 0.5)
    for turn in range(12):
        do(state, COMPARE, 0.4, done=8 * turn)
        for _ in range(4):
            do(state, LEVEL, 0.4, done=160)
    assert float(state.learned["environment"].detach().exp()[lamps].mean() / power) == pytest.approx(1, abs=0.15)
    assert float(state.surfels().albedo.detach().mean()) == pytest.approx(0.4, abs=0.05)


def test_metal_tells_nothing(start, tmp_path):
    assert compared(shot(start, tmp_path / "run", metallic=0.98)[0]) is None


def learned(state, roughness):
    """Set the roughness that was learned; return its mean after photos have been compared."""
    state.learned["roughness"].data.fill_(torch.tensor(roughness).logit())
    do(state, FIND, 0.5, done=34)
    do(state, KEEP, 0.5, done=20)
    return float(state.surfels().roughness.detach().mean())


def test_paint_that_became_rough_is_glossy_again(start, tmp_path):
    """Check that roughness falls, look by look, until pictures vary as photos do: also if highlights are elsewhere, and photos noisy."""
    state, _ = shot(start, tmp_path / "run")
    found = learned(state, 0.7)
    assert found < 0.6
    for _ in range(8):
        found = learned(state, found)
    assert found == pytest.approx(0.3, abs=0.08)
    light = state.learned["environment"].data
    light.copy_(light.view(6, -1, 3).flip(1).reshape(-1, 3))  # highlights move
    for view, photo in enumerate(state.photos):
        noise = torch.randn(photo.image.shape, generator=torch.Generator().manual_seed(view))
        state.photos[view] = photo._replace(image=(photo.image + 3 * noise).clamp(0, 255).to(torch.uint8))
    assert learned(state, 0.7) < 0.6


def test_paint_that_is_rough_stays_so(start, tmp_path):
    state, _ = shot(start, tmp_path / "run", roughness=0.7)
    for roughness, bounds in ((0.7, (0.68, 0.98)), (0.4, (0.39, 0.401))):
        assert bounds[0] <= learned(state, roughness) <= bounds[1], "what is too glossy learns by itself"
    assert float(state.learned["roughest"].detach().mean()) > 0.45


def test_metal_may_be_rough(start, tmp_path):
    state, _ = shot(start, tmp_path / "run", metallic=0.98)
    assert learned(state, 0.9) == pytest.approx(0.9, abs=1e-3)
    assert (gloss.roughest(state, torch.zeros(state.learned.count, dtype=torch.bool), 0) == 1).all()
