"""Test that base colours are kept as bright as what metals mirror of the object tells, and paint in the bounds of experience."""

import torch

from refgs.model.surfels import raw_metallic
from refgs.train.keep import snapshot
from refgs.train.material import brightness, metals
from tests.makers.pieces import ball_on_board, reckoned
from tests.makers.training import do, put
from tests.makers.training import trainer as small


def ball(by_object):
    """Return the base colours of a metal ball, a third of the true ones, on paint, and what was reckoned: it reflects 0.8."""
    points, normals, metal = ball_on_board()
    found = reckoned(points, normals, metal.float(), metal.float(), by_object)
    albedo = torch.where(metal[:, None], torch.tensor([0.8, 0.4, 0.2]) / 3, torch.tensor([0.6, 0.6, 0.6]))
    return albedo, found, metal


def test_the_brightness_follows_from_what_metals_mirror_of_the_object():
    albedo, found, metal = ball(True)
    assert torch.allclose(brightness.told(albedo, found, metal).exp(), torch.tensor(0.8), atol=1e-3)


def test_a_few_surfels_that_mirror_the_object_tell_of_all():
    albedo, found, metal = ball(False)
    tenth = metal & (torch.arange(len(metal)) % 10 == 0)
    found = found._replace(by_object=tenth, reflectance=torch.where(tenth[:, None], 0.8, 0.1))
    assert torch.allclose(brightness.told(albedo, found, metal).exp(), torch.tensor(0.8), atol=1e-3)


def test_metals_that_mirror_no_object_are_left_alone():
    albedo, found, metal = ball(False)
    assert brightness.told(albedo, found, metal) is None
    few = metal & (torch.arange(len(metal)) % 100 == 0)
    assert brightness.told(albedo, found._replace(by_object=few), metal) is None
    assert brightness.told(albedo, found, torch.zeros_like(metal)) is None, "nothing is metal"


def test_only_the_mean_is_kept(large_ball, tmp_path):
    """Check that metals are brighter by one factor, so that colours and differences between them stay, and dark paint stays as it is."""
    made = small(large_ball, tmp_path / "run", total=400)
    state = made.state
    albedo = 0.1 + 0.2 * torch.rand(state.learned.count, 3, generator=torch.Generator().manual_seed(0))
    metal = torch.arange(state.learned.count) % 3 > 0
    put(made, albedo=albedo.logit(), metallic=torch.where(metal, raw_metallic(0.98), raw_metallic(0.02)), told=True)
    state.part(metals.Metals).brightness = torch.tensor(0.6).log()
    do(state, "keep base colours' brightness", 0.3, done=120)
    now = state.surfels().albedo.detach()
    factor = now[metal] / albedo[metal]
    assert torch.allclose(factor, factor[0, 0].expand_as(factor), rtol=1e-3) and factor[0, 0] > 2
    assert torch.allclose(now[metal].amax(dim=1).log().mean().exp(), torch.tensor(0.6), atol=1e-3)
    assert torch.allclose(now[~metal], albedo[~metal], atol=1e-6)

    snapshot.save(state)
    again = small(large_ball, tmp_path / "again", total=400).state
    snapshot.restore(again, state.folder)
    assert torch.equal(again.part(metals.Metals).brightness, state.part(metals.Metals).brightness)


def test_paint_is_kept_from_being_white_everywhere(large_ball, tmp_path):
    """Check that paint keeps its mean below PAINT, if the metals' brightness is known, and that a hint counts as told."""
    made = small(large_ball, tmp_path / "run", total=400)
    state = made.state
    metal = torch.arange(state.learned.count) % 2 > 0
    albedo = torch.tensor([0.9, 0.6, 0.3]).expand(len(metal), 3)
    put(made, albedo=albedo.logit(), metallic=torch.where(metal, raw_metallic(0.98), raw_metallic(0.02)), held=True)
    do(state, "keep base colours' brightness", 0.3, done=120)
    assert torch.allclose(state.surfels().albedo, albedo, atol=1e-6), "the metals' is not known"
    state.part(metals.Metals).brightness = torch.tensor(0.9).log()
    do(state, "keep base colours' brightness", 0.3, done=120)
    now = state.surfels().albedo.detach()
    assert torch.allclose(now[metal], albedo[metal], atol=1e-3)
    assert torch.allclose(now[~metal], albedo[~metal] * brightness.PAINT / 0.9, atol=1e-3)


def test_base_colours_stay_below_one(large_ball, tmp_path):
    made = small(large_ball, tmp_path / "run", total=400)
    state = made.state
    put(made, albedo=torch.tensor([2.0, 0.0, -4.0]), metallic=raw_metallic(0.98), told=True)
    metal = torch.ones(state.learned.count, dtype=torch.bool)
    brightness.keep(state, metal, ~metal, torch.tensor(5.0))
    assert bool(state.learned["albedo"].isfinite().all()) and float(state.surfels().albedo.detach().max()) <= 0.981
