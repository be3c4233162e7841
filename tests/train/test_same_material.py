"""Test how surfels are told metal or paint by what they mirror, and how that spreads over a surface."""

import json
import math

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from refgs.formats.splats import read_splats
from refgs.model.surfels import activate, raw_metallic
from refgs.train.keep.asset import write_asset
from refgs.train.material import metals, mirrored, questions, same_material
from refgs.train.material.mirrored import Fit
from refgs.train.material.observe import Seen
from refgs.train.trainer import ACTIONS
from tests.makers.lamps import show
from tests.makers.training import do, put
from tests.makers.training import trainer as small

DIM = 1.3  # radiance of lamps whose mirror images are not clipped
GOLD = [3.0, 1.0, -1.0]  # logits: 0.95, 0.73, 0.27
ALL = ["surfels.sh_degree=0", "needs.specular=on", "needs.outside=off", "indirect.every=100"]


@pytest.fixture
def made(large_ball, tmp_path):
    made = small(large_ball, tmp_path / "run", *ALL, total=400)
    made.state.part(metals.Metals).found, made.state.iteration = True, 100
    return made


@pytest.mark.parametrize("turn", [False, True])
@pytest.mark.parametrize("roughness", [-3.0, -1.0])
def test_a_metal_shows_what_it_mirrors(made, roughness, turn):
    show(made, metallic=6.0, roughness=roughness, albedo=GOLD, turn=turn, lamp=DIM)
    _, _, fit = mirrored.fit_both(made.state)
    assert float(fit.seen.float().mean()) > 0.8
    assert float((fit.ratio[fit.seen] < same_material.RATIO.metal).float().mean()) > 0.8
    # Photos are rendered at half the light, as by a shorter exposure: so a metal's reflectance is half of its base colour.
    half = torch.tensor(GOLD).sigmoid() / 2
    assert torch.allclose(fit.reflectance[fit.seen].median(dim=0)[0], half, atol=0.06)
    assert float((fit.slope[fit.seen] > same_material.SLOPE).float().mean()) > 0.9


@pytest.mark.parametrize("albedo", [[1.0, 1.0, 1.0], [2.0, 0.0, -2.0]])
def test_paint_looks_the_same_from_everywhere(made, albedo):
    show(made, metallic=-6.0, roughness=-1.0, albedo=albedo)
    _, _, fit = mirrored.fit_both(made.state)
    assert float((fit.ratio[fit.seen] > same_material.RATIO.paint).float().mean()) > 0.8


def test_what_no_photo_shows_is_not_told(made):
    show(made, metallic=6.0, roughness=-1.0)
    state = made.state
    state.photos[:] = [photo._replace(image=torch.full_like(photo.image, 255)) for photo in state.photos]
    _, seen, fit = mirrored.fit_both(state)
    assert not fit.seen.any() and not seen.weight.any() and seen.pixels.any()


@pytest.mark.parametrize(
    ("diffuse", "reflectance", "metal"), [(0.0, 0.9, True), (0.0, 0.5, True), (0.005, 0.04, False), (0.2, 0.04, False)]
)
def test_a_metal_in_the_dark_is_told_by_what_it_mirrors_of_the_object(diffuse, reflectance, metal):
    """Check that a light which is learned a hundred times too bright does not matter where surfels mirror the object.

    The four surfaces are two metals, a black glaze and a bright one. In half of the photos, they mirror the object, in the others a room
    with a radiance of 0.002.
    """
    count, photos = 80, 12
    generator = torch.Generator().manual_seed(0)
    up = torch.tensor([0.0, 0.0, 1.0]).expand(count, photos, 3)
    there = 0.1 + 0.3 * torch.rand(photos, 1, 3, generator=generator).expand(photos, count, 3)
    met = (torch.arange(photos) % 2 == 0)[:, None].expand(photos, count)
    shown = diffuse + reflectance * torch.where(met[..., None], there, 0.002).transpose(0, 1)
    weight = torch.full((count, photos), 4.0)
    seen = Seen(shown, weight, 0 * weight, torch.full((count,), 48.0), shown.mean(dim=1), up, up)
    learned = torch.where(met[..., None], there, 0.2)
    positions = torch.rand(count, 3, generator=generator)
    fit = mirrored._fit(seen, (([each] * 3, which) for each, which in zip(learned, met, strict=True)), positions)
    assert bool(fit.by_object.all()) == bool(fit.by_object.any()) == metal
    if metal:
        assert float(fit.ratio.max()) < same_material.RATIO.metal and float(fit.slope.min()) > same_material.SLOPE
        assert torch.allclose(fit.reflectance, torch.tensor(reflectance), atol=0.03)


def ball_on_board(count=4000):
    """Return points and normals of a ball that stands on a board, and which of them are the ball's."""
    generator = torch.Generator().manual_seed(0)
    normal = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    normal = normal[normal[:, 2] > -0.95]
    board = 4 * torch.rand(count, 3, generator=generator) - 2
    board[:, 2] = 0
    up = torch.tensor([0.0, 0.0, 1.0]).expand(len(board), 3)
    points = torch.cat([normal + torch.tensor([0.0, 0.0, 1.0]), board])
    ball = torch.arange(len(points)) < len(normal)
    return points, torch.cat([normal, up]), ball


def observed(points, normals, ratio, metallic, mean=None, shown=None):
    """Make what `mirrored.observe` returns, if photos tell the `ratio` (N,) of errors and the training has the `metallic` (N,).

    `shown` (N,) are the surfels that photos show; all by default.
    """
    count = len(points)
    start = {"position": points, "albedo": torch.zeros(count, 3), "metallic": metallic, "roughness": torch.zeros(count)}
    start |= {"rotation": torch.tensor([1.0, 0, 0, 0]).expand(count, 4), "scale": torch.zeros(count, 2)}
    start |= {"opacity": torch.zeros(count), "received": torch.ones(count, 3), "sh_dc": torch.zeros(count, 1, 3)}
    start |= {name: torch.zeros(count, 15, 3) for name in ("sh_rest", "indirect_rest")}
    start["indirect_dc"] = torch.zeros(count, 1, 3)
    start["albedo"][:, 0] = torch.where(points[:, 2] > 1, 2.0, -2.0)
    start["roughness"] = torch.where(points[:, 2] > 1, -3.0, 0.0)
    mean = torch.full((count, 3), 0.5) if mean is None else mean
    one = torch.ones(count, 1)
    pixels = 9 * (torch.ones(count) if shown is None else shown.float())
    seen = Seen(mean[:, None], 9 * one, 0 * one, pixels, mean, normals[:, None], normals[:, None])
    told = torch.ones(count, dtype=torch.bool)
    fit = Fit(ratio, torch.full((count,), 0.5), torch.full((count, 3), 0.8), torch.full((count,), 0.2), told, ~told)
    return activate(start), seen, fit


def decided(*given):
    """Decide what is metal; the arguments are those of `observed`."""
    return same_material.decide(*observed(*given))


def test_a_balls_lower_half_is_of_its_upper_halfs_metal():
    """Check that evidence for metal crosses the ball's equator, but not the crease to the board."""
    points, normals, ball = ball_on_board()
    ratio = torch.where(ball & (points[:, 2] > 1), 0.3, 1.0)
    metallic = torch.where(ball & (points[:, 2] > 1), raw_metallic(0.98), raw_metallic(0.02))
    found = decided(points, normals, ratio, metallic)
    metal = found.metal | (metallic > 0)
    assert float(metal[ball].float().mean()) > 0.98 and float(metal[~ball].float().mean()) < 0.02
    lower = ball & (points[:, 2] < 0.8)
    like = found.like_metals[lower].mean(dim=0)
    assert like[0] == pytest.approx(1 / (1 + math.exp(-2)), abs=0.05), "the base colour of the upper half"
    assert like[3] == pytest.approx(1 / (1 + math.exp(3)), abs=0.05), "its roughness"


def test_evidence_spreads_as_far_however_dense_surfels_are():
    """Check how far the top of a mirror ball tells that the rest, of which photos tell nothing, is metal."""
    lowest = []
    for count in (8000, 32000):
        points, normals, ball = ball_on_board(count)
        told = ball & (points[:, 2] > 1.8)
        metallic = torch.where(told, raw_metallic(0.98), raw_metallic(0.02))
        found = decided(points, normals, torch.where(told, 0.3, 1.0), metallic)
        lowest.append(float(points[found.metal, 2].quantile(0.02)))
    assert lowest == pytest.approx([1.37, 1.37], abs=0.04)


def test_metals_that_nothing_was_learned_of_are_as_they_fit():
    points, normals, ball = ball_on_board()
    found = decided(points, normals, torch.where(ball, 0.3, 1.0), torch.full((len(points),), raw_metallic(0.02)))
    like = found.like_metals[ball]
    assert torch.allclose(like, torch.tensor([0.8, 0.8, 0.8, 0.2]).expand_as(like), atol=0.01)


def test_paint_of_another_brightness_stays_paint():
    """Check a ball whose lower half is painted black: no crease, but an edge of its brightness."""
    points, normals, ball = ball_on_board()
    upper = points[:, 2] > 1
    mean = torch.where(upper, 0.6, 0.01)[:, None].expand(-1, 3)
    ratio = torch.where(upper, 0.3, 1.7)
    found = decided(points, normals, ratio, torch.full((len(points),), raw_metallic(0.02)), mean)
    assert float(found.metal[ball & (points[:, 2] < 0.95)].float().mean()) < 0.02


def test_a_surface_that_is_clearly_paint_does_not_stay_metal():
    points, normals, ball = ball_on_board()
    ratio = torch.where(ball, 0.3, torch.where(points[:, 0] > 0, 8.0, 1.0))
    found = decided(points, normals, ratio, torch.full((len(points),), raw_metallic(0.98)))
    board = ~ball & (points[:, 0] > 0.2)
    assert float(found.paint[board].float().mean()) > 0.95 and not found.paint[ball].any()


def test_without_evidence_all_stays_as_it_is():
    points, normals, ball = ball_on_board()
    metallic = torch.where(ball, raw_metallic(0.98), raw_metallic(0.02))
    found = decided(points, normals, torch.ones(len(points)), metallic)
    assert not found.metal.any() and not found.paint.any()


@pytest.mark.parametrize("metallic", [0.02, 0.98])
def test_what_photos_do_not_tell_is_in_doubt(metallic):
    """Check a ball whose upper half photos tell to be metal, on a board of which they tell nothing, whatever was learned so far."""
    points, normals, ball = ball_on_board()
    ratio = torch.where(ball & (points[:, 2] > 1), 0.3, 1.0)
    doubt = same_material.doubt(*observed(points, normals, ratio, torch.full((len(points),), raw_metallic(metallic))))
    assert bool((doubt[ball & (points[:, 2] > 1.2)] < 0.1).all())
    assert bool((doubt[ball] < questions.DOUBTFUL).all()), "its lower half is of a piece with its upper half"
    assert bool((doubt[~ball] > 0.99).all())


def test_clear_paint_is_not_in_doubt():
    points, normals, ball = ball_on_board()
    ratio = torch.where(ball, 1.0, 4.0)
    doubt = same_material.doubt(*observed(points, normals, ratio, torch.full((len(points),), raw_metallic(0.98))))
    assert bool((doubt[~ball] < 0.1).all()) and bool((doubt[ball] > 0.99).all())


def test_pieces_in_doubt_end_at_creases():
    """Check that a ball and the board that it stands on are two pieces, the larger one first, without what is not in doubt."""
    points, normals, ball = ball_on_board()
    surfels, seen, _ = observed(points, normals, torch.ones(len(points)), torch.zeros(len(points)))
    doubt = torch.where(ball & (points[:, 2] > 1.2), 0.1, 0.9)
    weight = torch.where(ball, 3.0, 1.0).numpy()
    first, second, *others = questions.pieces(surfels, seen, doubt, weight)
    assert np.array_equal(first, (ball & (points[:, 2] <= 1.2)).numpy()) or np.array_equal(first, (~ball).numpy())
    assert np.array_equal(first | second, (doubt > 0.5).numpy()) and not others
    assert weight[first].sum() >= weight[second].sum()


def test_a_question_is_asked_about_what_photos_leave_open(made):
    """Check the question about a ball under even light, its picture, and that nothing is asked of one that photos show clearly."""
    show(made, metallic=6.0, roughness=-3.0, albedo=GOLD, lamp=DIM)
    write_asset(made.state)
    assert not (made.state.folder / "questions.json").exists()
    made.state.learned["environment"].data[:] = made.state.learned["environment"].data.mean()
    write_asset(made.state)
    (asked,) = json.loads((made.state.folder / "questions.json").read_text())["questions"]
    assert asked["part"] > 0.9 and asked["now"] == "metal"
    splats = read_splats(made.state.folder / "splats.ply").positions
    assert cKDTree(splats).query(asked["points"])[0].max() < 1e-4 and len(asked["points"]) > 0.9 * len(splats)
    picture = cv2.imread(str(made.state.folder / asked["picture"]))
    height, width = picture.shape[0] // 3, picture.shape[1] // 2
    photo, below = picture[: 2 * height : 2, ::2].astype(float), picture[2 * height :].astype(float)
    metal, paint = below[:, :width], below[:, width:]
    assert np.abs(photo - metal).mean() < 30, "the learned metal explains the photos"
    assert np.abs(metal - paint).mean() > 1, "the two differ"
    show(made, metallic=6.0, roughness=-3.0, albedo=GOLD, lamp=DIM)
    write_asset(made.state)
    assert not (made.state.folder / "questions.json").exists() and not (made.state.folder / "questions").exists()


def test_what_hardly_any_pixel_shows_is_in_doubt():
    points, normals, _ = ball_on_board()
    given = observed(points, normals, torch.full((len(points),), 0.3), torch.zeros(len(points)), None, points[:, 0] > 0)
    doubt = same_material.doubt(*given)
    assert bool((doubt[points[:, 0] < 0] == 1).all()) and bool((doubt[points[:, 0] > 0] < 0.1).all())


def test_how_much_of_the_surface_is_in_doubt_is_said(made):
    """Check a metal ball that photos show clearly, and a light that is the same from everywhere, under which they tell nothing."""
    show(made, metallic=6.0, roughness=-3.0, albedo=GOLD, lamp=DIM)
    doubt, facts, _ = metals.doubt(made.state)
    assert len(doubt) == made.state.learned.count and facts["part"] < 0.05
    made.state.learned["environment"].data[:] = made.state.learned["environment"].data.mean()
    doubt, facts, _ = metals.doubt(made.state)
    assert facts["part"] > 0.9 and facts["what"] == made.state.decided["doubt"]
    assert facts["what"] == f"photos do not tell metal from paint on {facts['part']:.0%} of the surface"


def test_the_asset_has_the_doubt_of_the_surfels_that_are_written(made):
    show(made, metallic=6.0, roughness=-3.0, albedo=GOLD, lamp=DIM)
    position, light = made.state.learned["position"], made.state.learned["environment"]
    position.data[0] = 0  # within the ball, so that no photo shows it
    light.data[:] = light.data.mean()
    doubt, facts, _ = metals.doubt(made.state)
    write_asset(made.state)
    splats = read_splats(made.state.folder / "splats.ply")
    row = {tuple(place): i for i, place in enumerate(position.tolist())}
    written = [row[tuple(place)] for place in splats.positions.tolist()]
    assert 0 not in written and np.array_equal(splats.doubt, doubt.numpy()[written])
    assert json.loads((made.state.folder / "metrics.json").read_text())["doubt"] == facts


def test_metals_that_are_held_are_not_in_doubt(made):
    show(made, metallic=6.0, roughness=-3.0, albedo=GOLD, lamp=DIM)
    made.state.learned["environment"].data[:] = made.state.learned["environment"].data.mean()
    put(made, metallic=raw_metallic(metals.HELD.metal), held=True)
    facts = metals.doubt(made.state)[1]
    assert facts["part"] < 0.002 and "what" not in facts, "only what hardly any pixel shows is"


@pytest.mark.parametrize("change", ["render.reflection=none", "propagation.every=50"])
def test_doubt_is_only_measured_where_photos_decide(large_ball, tmp_path, change):
    assert metals.doubt(small(large_ball, tmp_path / "run", "surfels.sh_degree=0", change).state) is None


def test_half_a_mirror_makes_all_of_it_metal(made):
    """Check that the half of a metal ball that was learned as dark paint becomes metal like the rest."""
    show(made, metallic=6.0, roughness=-3.0, albedo=GOLD, lamp=DIM)
    state = made.state
    shown = mirrored.fit_both(state)[1].pixels > same_material.FRINGE
    left = shown & (state.learned["position"][:, 0] < -0.2)
    state.learned["metallic"].data[left] = raw_metallic(0.01)
    half = torch.tensor(GOLD).sigmoid() / 2  # photos are rendered at half the light
    state.learned["albedo"].data[:] = half.logit()
    state.learned["albedo"].data[left] = -3.0
    state.learned["roughness"].data[left] = 1.0
    do(state, "judge metals", 0.25, hidden=0.1)
    with torch.no_grad():
        found = activate(state.learned.constant | state.learned.by_row)
    assert float((found.metallic > 0.8)[left].float().mean()) > 0.95
    assert torch.allclose(found.albedo[left].median(dim=0)[0], half, atol=0.05)
    assert float(found.roughness[left].median()) == pytest.approx(1 / (1 + math.exp(3)), abs=0.02)
    assert "of a piece with metals" in state.decided["mirrored"]


def test_paint_that_was_taken_for_metal_becomes_paint(made):
    show(made, metallic=-6.0, roughness=-1.0)
    state = made.state
    put(made, metallic=raw_metallic(0.9))
    do(state, "judge metals", 0.25, hidden=0.1)
    assert float((state.surfels().metallic < 0.1).float().mean()) > 0.3, "where lamps should show most clearly"


@pytest.mark.parametrize("hidden, progress, held", [(None, 0.25, False), (0.1, 0.9, False), (0.1, 0.25, True)])
def test_materials_are_judged_with_new_meshes_unless_held(made, hidden, progress, held):
    """Check that nothing changes between meshes, when the residual learns, and where metals are held."""
    show(made, metallic=-6.0, roughness=-1.0)
    state = made.state
    before = raw_metallic(0.9)
    put(made, metallic=before, held=held)
    do(state, "judge metals", progress, hidden=hidden)
    assert bool((state.learned["metallic"] == torch.tensor(before)).all())


def test_where_no_mesh_is_made_materials_are_judged_by_a_clock_of_their_own(made, monkeypatch):
    state, judged = made.state, []
    monkeypatch.setitem(ACTIONS, "judge metals", lambda state, step: judged.append(step.done))
    state.change("indirect.every", 30, "plan", "the test says so")
    for done in range(1, 200):
        do(state, "judge metals", 0.25, done=done)
    assert judged == [], "a mesh will be made"
    state.change("indirect.start", 1.0, "plan", "the test says so")
    for done in range(1, 200):
        do(state, "judge metals", 0.25, done=done)
    assert judged == [50, 100, 150], "an eighth of 400 iterations"
