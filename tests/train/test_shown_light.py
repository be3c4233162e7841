"""Test how the light is estimated from what metals show of it, and from what paint receives."""

import math

import pytest
import torch

from refgs.model.environment import Environment
from refgs.train.material import metals, mirrored
from refgs.train.material.shown_light import error, shown_light
from tests.makers.lamps import LAMPS, show
from tests.makers.training import put
from tests.makers.training import trainer as small

SMOOTH = -5.0  # logit of a roughness of 0.007
EXPOSED = 0.5  # factor on the radiance in the photos of `show`
SILVER, PAINT = torch.tensor([3.0] * 3), torch.tensor([-0.4] * 3)  # logits: 0.95, 0.4


@pytest.fixture
def made(large_ball, tmp_path):
    made = small(
        large_ball, tmp_path / "run", "surfels.sh_degree=0", "needs.specular=on", "needs.outside=off", total=400
    )
    made.state.part(metals.Metals).found, made.state.iteration = True, 100
    return made


def shown_by(made, metal):
    surfels, seen, _ = mirrored.fit_both(made.state)
    return shown_light(made.state, surfels, seen, metal, surfels.albedo)


def test_metals_show_the_light(made):
    """Check the light that a silver ball shows, where photos are not clipped, though the light learned so far is another one."""
    show(made, metallic=6.0, roughness=SMOOTH, albedo=SILVER, lamp=1.3)
    true = made.state.environment().radiance.detach()
    made.state.learned["environment"].data.fill_(0.0)
    found = shown_by(made, torch.ones(made.state.learned.count, dtype=torch.bool)) / EXPOSED
    off = (found / true).log().mean(dim=1)
    # Each surfel mirrors a few texels, so that lamps have blurred edges.
    assert abs(float(off.median())) < 0.1 and float(off.abs().median()) < 0.5


@pytest.mark.parametrize("lamp", [5.0, 10.0])
def test_paint_tells_how_bright_clipped_lamps_are(made, lamp):
    """Check how much light a ball finds, one half of it silver and the other half paint with a base colour of 0.4."""
    metal = made.state.learned["position"][:, 0] > 0
    albedo = torch.where(metal[:, None], SILVER, PAINT)
    show(made, metallic=torch.where(metal, 6.0, -6.0), roughness=SMOOTH, albedo=albedo, lamps=LAMPS[2:3], lamp=lamp)
    true = made.state.environment().diffuse(LAMPS[2:3]).mean().detach()
    put(made, albedo=torch.where(metal[:, None], SILVER, 0.0))
    made.state.learned["environment"].data.fill_(0.0)
    found = shown_by(made, metal) / EXPOSED
    assert 0.7 < float(Environment(found).diffuse(LAMPS[2:3]).mean() / true) < 1.4
    assert 0.1 < float(found.median()) < 0.4, "the room keeps its radiance of 0.2"


def test_without_metals_nothing_is_shown(made):
    show(made, metallic=-6.0, roughness=SMOOTH)
    assert shown_by(made, torch.zeros(made.state.learned.count, dtype=torch.bool)) is None


def test_the_light_starts_over_where_photos_agree(made):
    """Check that a wrong light under which silver was learned as dull and dark is replaced, and that the true light is kept."""
    show(made, metallic=6.0, roughness=SMOOTH, albedo=SILVER, lamp=1.3)
    state = made.state
    with torch.no_grad():
        state.learned["environment"].add_(math.log(EXPOSED))
    true = state.learned["environment"].detach().clone()
    like = torch.tensor([0.95, 0.95, 0.95, 0.05]).expand(state.learned.count, 4)
    surfels, seen, _ = mirrored.fit_both(state)
    metals._take_shown_light(state, surfels, seen, like)
    assert torch.equal(state.learned["environment"], true) and "shown light" not in state.decided
    put(made, roughness=0.5, albedo=torch.full((3,), -1.5))
    state.learned["environment"].data.fill_(0.0)
    before = error(state, state.inputs())
    surfels, seen, _ = mirrored.fit_both(state)
    metals._take_shown_light(state, surfels, seen, like)
    assert error(state, state.inputs()) < 0.5 * before and "shown light" in state.decided
    assert torch.allclose(state.surfels().albedo, like[:, :3], atol=1e-3)
