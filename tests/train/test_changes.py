"""Test how changes with the viewing direction are measured, and how they tell coloured metals.

The photos are renderings of the model itself, whose materials are known.
"""

import pytest
import torch

from refgs.model.surfels import activate, raw_metallic
from refgs.train.decide.materials import SHINES
from refgs.train.learn.densify import Densification, densify
from refgs.train.material import changes, metals
from refgs.train.material.changing_light import CHANGED, LEFT, explained
from refgs.train.material.metals import Metals
from refgs.train.material.observe import observe_changes
from tests.makers.lamps import LAMPS, ORANGE, show
from tests.makers.training import do, put
from tests.makers.training import trainer as small

ALL = ["surfels.sh_degree=0", "needs.specular=on", "needs.outside=off"]


@pytest.fixture
def made(large_ball, tmp_path):
    return small(large_ball, tmp_path / "run", *ALL, total=400)


def told(made):
    """Return which part of the usable surface shines as metal, and how much the surface changes with the view."""
    state = made.state
    found = observe_changes(state)
    usable = found.usable.any(dim=1)
    metal = changes.shines_as_metal(found, state.learned["position"].detach()).clearly
    change = changes.change_seen(found, state.wanted())
    return float(metal[usable].float().mean()), change


@pytest.mark.parametrize("turn", [False, True])
@pytest.mark.parametrize("exposure", [(1.0,), (1.0, 0.8, 1.2)])
def test_a_tinted_change_is_a_metals(made, exposure, turn):
    show(made, metallic=6.0, roughness=-1.0, exposure=exposure, turn=turn)
    metal, change = told(made)
    assert metal > 0.8 and change > 2 * SHINES


def test_a_grey_change_is_a_dielectrics(made):
    show(made, metallic=-6.0, roughness=-2.5, albedo=[-1.0, -2.5, -4.0])
    metal, change = told(made)
    assert metal < 0.02 and change > SHINES


@pytest.mark.parametrize("turn", [False, True])
@pytest.mark.parametrize("exposure", [(1.0,), (1.0, 0.8, 1.2)])
def test_what_is_matte_does_not_change(made, exposure, turn):
    """Check a matte surface whose photos differ in exposure, and one that is lit from another side in each photo."""
    made.state.change("render.reflection", "none", "needs", "the test has a matte ball")
    show(made, metallic=-6.0, roughness=6.0, exposure=exposure, turn=turn)
    metal, change = told(made)
    assert change < 0.75 * SHINES and metal < 0.05 and falls(made) < 0.02


def test_a_grey_surface_tells_nothing(made):
    show(made, metallic=6.0, roughness=-1.0, albedo=[1.0, 1.0, 1.0])
    metal, change = told(made)
    assert metal < 0.02 and change > 2 * SHINES


def falls(made):
    """Return which part of the usable surface falls as far below its median as only metals do."""
    state = made.state
    found = observe_changes(state)
    light = float(state.environment().radiance.detach().mean())
    metal = changes.falls_as_metal(found, state.learned["position"].detach(), light)
    return float(metal[found.usable.any(dim=1)].float().mean())


@pytest.mark.parametrize("exposure", [(1.0,), (1.0, 0.8, 1.2)])
def test_only_a_metal_falls_far_below_its_median(made, exposure):
    """Check grey metal against grey, orange and black glaze, under lamps that are much brighter than what is around them."""
    show(made, metallic=6.0, roughness=-1.0, albedo=[1.0, 1.0, 1.0], exposure=exposure)
    assert falls(made) > 0.25
    for color in ([1.0, 1.0, 1.0], ORANGE, [-4.0, -4.0, -4.0]):
        show(made, metallic=-6.0, roughness=-1.0, albedo=color, exposure=exposure)
        assert falls(made) < 0.02


def test_a_small_part_that_shines_counts(made):
    """Check that a patch of chrome, 4 % of a matte surface, changes the surface's figure by more than the threshold."""
    state = made.state
    show(made, metallic=6.0, roughness=-4.0, albedo=[3.0, 3.0, 3.0])
    found = observe_changes(state)
    still = found._replace(change=0.02 * torch.randn(found.change.shape, generator=torch.Generator().manual_seed(2)))
    assert changes.change_seen(still, state.wanted()) < SHINES
    usable = found.usable.any(dim=1).nonzero()[:, 0]
    patch = usable[::25]
    still.change[patch] = found.change[patch]
    assert changes.change_seen(still, state.wanted()) > SHINES


def explanation(made):
    """Explain the changes of all surfels."""
    found, positions = observe_changes(made.state), made.state.learned["position"].detach()
    (whole,) = explained(found, positions, made.state.capture.radius, torch.ones(len(positions), dtype=torch.bool))
    return whole


def test_a_light_that_changes_does_not_make_metal(made):
    """Check a matte ball that is lit from another side in each photo, taken as one under a light that stands still."""
    state = made.state
    state.change("render.reflection", "none", "needs", "the test has a matte ball")
    show(made, metallic=-6.0, roughness=6.0, turn=True, lamps=LAMPS[:1])
    state.change("light.frame", "world", "photos", "the photos do not tell")
    state.change("render.reflection", "microfacet", "needs", "nor do they tell this")
    assert told(made)[0] > 0.5, "its colours alone are a metal's"
    found = explanation(made)
    assert found.by_changes and found.lit > 0.375 and found.lit - found.mirrored > 1.5 * CHANGED
    assert found.both - found.lit < 0.5 * LEFT * (1 - found.lit)
    put(made, metallic=0.0)
    do(state, "find metals", 0.25, done=100)
    assert (state.surfels().metallic < 1.01 * metals.GIVEN.paint).all() and "0%" in state.decided["metals"]


def test_coloured_noise_does_not_make_metal(made):
    """Check an orange matte ball whose parts are brighter or darker in each photo, as fur is that hides and shows what is below it."""
    state = made.state
    state.change("render.reflection", "none", "needs", "the test has a matte ball")
    generator = torch.Generator().manual_seed(3)
    positions = state.learned["position"].detach() / state.capture.radius
    photos = []
    for view in range(len(state.photos)):
        waves, phases = 6 * torch.randn(3, 12, generator=generator), 6 * torch.rand(12, generator=generator)
        brighter = (1.5 * (positions @ waves + phases).sin().mean(dim=1, keepdim=True)).exp()
        show(made, metallic=-6.0, roughness=6.0, albedo=torch.logit(0.4 * brighter * torch.tensor(ORANGE).sigmoid()))
        photos.append(state.photos[view])
    state.photos[:] = photos
    state.change("render.reflection", "microfacet", "needs", "the photos do not tell this")
    assert told(made)[0] > 0.3, "its colours alone are a metal's"
    put(made, metallic=0.0)
    do(state, "find metals", 0.25, done=100)
    assert float((state.surfels().metallic < 1.01 * metals.GIVEN.paint).float().mean()) > 0.9
    assert "0%" in state.decided["metals"] and state.settings.loss.dark > 0


@pytest.mark.parametrize("roughness", [-1.0, 0.5])  # a sharp image of these lamps is clipped, which tells nothing
@pytest.mark.parametrize("turn", [False, True])
def test_metals_mirror(made, roughness, turn):
    show(made, metallic=6.0, roughness=roughness, turn=turn)
    found = explanation(made)
    assert not found.by_changes and found.both - found.lit > 2 * LEFT * (1 - found.lit)


def test_metals_are_set_once(made):
    show(made, metallic=6.0, roughness=-1.0)
    state = made.state
    put(made, metallic=0.0)
    do(state, "find metals", 0.25, done=99)
    do(state, "find metals", 0.05, done=100)
    assert not state.part(Metals).found and "metals" not in state.decided
    do(state, "find metals", 0.25, done=100)
    metallic = activate(state.learned.constant | state.learned.by_row).metallic
    assert state.part(Metals).found and float((metallic > metals.GIVEN.metal - 1e-3).float().mean()) > 0.5
    assert "as metals do" in state.decided["metals"] and state.settings.loss.dark == 0
    put(made, metallic=0.0)
    do(state, "find metals", 0.3, done=101)
    assert (state.learned["metallic"] == 0).all()


def test_propagation_finds_metals_by_itself(large_ball, tmp_path):
    made = small(large_ball, tmp_path / "run", *ALL, "propagation.every=20", total=400)
    show(made, metallic=6.0, roughness=-1.0)
    put(made, metallic=0.0)
    do(made.state, "find metals", 0.25, done=100)
    assert not made.state.part(Metals).found and (made.state.learned["metallic"] == 0).all()


@pytest.mark.parametrize("roughness", [-1.0, 1.0])  # rough metal changes by less than may be texture out of place
def test_what_is_metal_all_over_is_held(made, roughness):
    """Check that a ball of metal stays metal while everything else learns, and that halves of its surfels are held, too."""
    show(made, metallic=6.0, roughness=roughness)
    state = made.state
    put(made, metallic=0.0)
    do(state, "find metals", 0.25, done=100)
    held = int(state.learned["held"].sum())
    assert held > 0.9 * len(state.learned["metallic"])
    before = state.learned["roughness"].detach().clone()
    for _ in range(5):
        made.step()
    assert int((state.learned["metallic"] == raw_metallic(metals.HELD.metal)).sum()) == held
    assert not torch.equal(state.learned["roughness"], before)
    gradient = torch.ones(state.learned.count)
    divided = densify(state.learned, gradient, state.settings.densify, 2 * len(gradient), divide=True)
    state.part(Densification).restart(state)
    made.step()
    assert divided > 0
    assert int((state.learned["metallic"] == raw_metallic(metals.HELD.metal)).sum()) > held + 0.9 * divided


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


def test_a_metallic_that_has_the_held_value_by_chance_still_learns(ball_capture, tmp_path):
    made = small(ball_capture, tmp_path / "run", "train.light_first=0", total=100)
    put(made, metallic=raw_metallic(metals.HELD.metal))
    made.state.part(Metals).found = True
    before = made.state.learned["metallic"].detach().clone()
    put(made, held=torch.arange(len(before)) % 2 == 0)
    made.step()
    moved = made.state.learned["metallic"] != before
    assert not moved[::2].any() and moved[1::2].any()
