"""Test how changes with the viewing direction are measured, and what explains them.

The photos are renderings of the model itself, whose materials are known.
"""

import pytest
import torch

from refgs.train.decide.materials import SHINES
from refgs.train.material import changing_light
from refgs.train.material.changes import change_seen
from refgs.train.material.changing_light import explained
from refgs.train.material.metals import Metals
from refgs.train.material.observe import NEIGHBOURS, neighbours, observe_changes
from tests.makers.lamps import LAMPS, ORANGE, show
from tests.makers.training import copied, do, put
from tests.makers.training import trainer as small

ALL = ["surfels.sh_degree=0", "needs.specular=on", "needs.outside=off"]


@pytest.fixture(scope="module")
def start(large_ball, tmp_path_factory):
    return small(large_ball, tmp_path_factory.mktemp("runs") / "start", *ALL, total=400)


@pytest.fixture
def made(start, tmp_path):
    return copied(start, tmp_path / "run")


def change(made):
    return change_seen(observe_changes(made.state), made.state.wanted())


@pytest.mark.parametrize("turn", [False, True])
@pytest.mark.parametrize("exposure", [(1.0,), (1.0, 0.8, 1.2)])
def test_a_metal_changes_with_the_view(made, exposure, turn):
    show(made, metallic=6.0, roughness=-1.0, exposure=exposure, turn=turn)
    assert change(made) > 2 * SHINES


@pytest.mark.parametrize("turn", [False, True])
@pytest.mark.parametrize("exposure", [(1.0,), (1.0, 0.8, 1.2)])
def test_what_is_matte_does_not_change(made, exposure, turn):
    """Check a matte surface whose photos differ in exposure, and one that is lit from another side in each photo."""
    made.state.change("render.reflection", "none", "needs", "the test has a matte ball")
    show(made, metallic=-6.0, roughness=6.0, exposure=exposure, turn=turn)
    assert change(made) < 0.75 * SHINES


def test_a_small_part_that_shines_counts(made):
    """Check that a patch of chrome, 4 % of a matte surface, changes the surface's figure by more than the threshold."""
    state = made.state
    show(made, metallic=6.0, roughness=-4.0, albedo=[3.0, 3.0, 3.0])
    found = observe_changes(state)
    still = found._replace(change=0.02 * torch.randn(found.change.shape, generator=torch.Generator().manual_seed(2)))
    assert change_seen(still, state.wanted()) < SHINES
    usable = found.usable.any(dim=1).nonzero()[:, 0]
    patch = usable[::25]
    still.change[patch] = found.change[patch]
    assert change_seen(still, state.wanted()) > SHINES


def explanation(made):
    """Explain the changes of all surfels."""
    points = made.state.learned["position"].detach()
    return explained(observe_changes(made.state), points, neighbours(points, NEIGHBOURS), made.state.capture.radius)


def test_a_light_that_changes_explains_more_than_mirroring(made):
    """Check a matte ball that is lit from another side in each photo, taken as one under a light that stands still."""
    state = made.state
    state.change("render.reflection", "none", "needs", "the test has a matte ball")
    show(made, metallic=-6.0, roughness=6.0, turn=True, lamps=LAMPS[:1])
    state.change("light.frame", "world", "photos", "the photos do not tell")
    found = explanation(made)
    assert found.lit > 0.375 and found.lit - found.mirrored > 0.25 and 0 < found.error < 0.1
    state.part(changing_light.ChangingLight).start(state)
    near = neighbours(state.learned["position"].detach(), NEIGHBOURS)
    assert changing_light.lead(state, near) == pytest.approx(changing_light.MOST)
    show(made, metallic=6.0, roughness=0.5)
    assert changing_light.lead(state, near) == pytest.approx(changing_light.MOST), "it is measured once"


def test_a_lead_is_less_by_its_standard_error(made, monkeypatch):
    """Check changes at random in patches of the surface: single cells tell the more of both models the larger the patches are."""
    state, found = made.state, {}
    points, seen = state.learned["position"].detach(), observe_changes(state)
    near, radius = neighbours(points, NEIGHBOURS), state.capture.radius
    for size in (0.1, 0.4):
        patch = (points / (size * radius)).floor().long() + 16
        noise = torch.rand(33, 33, 33, seen.pixels.shape[1], generator=torch.Generator().manual_seed(0))[tuple(patch.T)]
        noisy = seen._replace(change=0.2 * (noise[..., None] - 0.5).expand_as(seen.change))
        monkeypatch.setattr(changing_light, "observe_changes", lambda state, noisy=noisy: noisy)
        state.part(changing_light.ChangingLight).start(state)
        found[size] = explained(noisy, points, near, radius)
        more = found[size].lit - found[size].mirrored
        assert changing_light.lead(state, near) == pytest.approx(max(more - found[size].error, 0), abs=1e-6)
    assert 0 < found[0.1].error < found[0.4].error


@pytest.mark.parametrize("roughness", [-1.0, 0.5])  # a sharp image of these lamps is clipped, which tells nothing
@pytest.mark.parametrize("turn", [False, True])
def test_mirroring_explains_more_than_a_light_that_changes(made, roughness, turn):
    show(made, metallic=6.0, roughness=roughness, turn=turn)
    found = explanation(made)
    assert found.lit - found.mirrored < 0.2 and found.both > 0.5


@pytest.mark.parametrize("albedo, even", [(ORANGE, True), ([1.0, 1.0, 1.0], False)])
def test_paint_is_averaged_on_coloured_metal_only(made, albedo, even):
    """Check that base colours differ less where the surface is coloured metal, and are left alone elsewhere and late in the training."""
    state = made.state
    upper = state.learned["position"].detach()[:, 2] > 0
    noise = 0.5 * torch.randn(len(upper), 1, generator=torch.Generator().manual_seed(0))
    paint = torch.tensor(albedo) + noise  # brighter and darker
    put(made, metallic=torch.where(upper, 6.0, -6.0), albedo=paint, opacity=2.0)
    state.part(Metals).found = True
    do(state, "even coloured metal out", 0.6, done=50)
    do(state, "even coloured metal out", 0.5, done=51)
    assert torch.equal(state.learned["albedo"], paint)
    do(state, "even coloured metal out", 0.5, done=50)
    found = state.learned["albedo"].detach() - torch.tensor(albedo)
    assert torch.equal(state.learned["albedo"][~upper], paint[~upper])
    if even:
        assert float(found[upper].std()) < 0.35 * float(noise[upper].std())  # of 16 neighbours: 1/4
        assert float(found[upper].mean()) == pytest.approx(float(noise[upper].mean()), abs=0.03)
    else:
        assert torch.equal(state.learned["albedo"], paint)
