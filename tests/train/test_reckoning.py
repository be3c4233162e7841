"""Test how surfels are told metal or paint by what photos show of them, and what follows for a training."""

import json
import math

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from benchmarks.scenes.still import METALS
from refgs.formats.splats import read_splats
from refgs.model.surfels import activate, raw_metallic
from refgs.train.keep.asset import write_asset
from refgs.train.learn.densify import Densification, densify
from refgs.train.material import metals, mirrored, questions, reckoning
from refgs.train.material.observe import NEIGHBOURS, Seen, neighbours
from refgs.train.plan import Plan
from refgs.train.state import State
from refgs.train.timeline import metals_judged_again
from refgs.train.trainer import ACTIONS
from tests.makers.lamps import LAMPS, ORANGE, show
from tests.makers.pieces import ball_on_board, reckoned
from tests.makers.training import copied, do, put
from tests.makers.training import trainer as small

DIM = 1.3  # radiance of lamps whose mirror images are not clipped
GREY, GOLD = [3.0, 3.0, 3.0], [3.0, 1.0, -1.0]  # logits: 0.95, 0.73, 0.27
EVEN, UNEVEN = (1.0,), (1.0, 0.8, 1.2)  # exposures
ALL = ["surfels.sh_degree=0", "needs.specular=on", "needs.outside=off", "indirect.every=100", "indirect.resolution=48"]


@pytest.fixture(scope="module")
def start(large_ball, tmp_path_factory):
    made = small(large_ball, tmp_path_factory.mktemp("runs") / "start", *ALL, total=400)
    made.state.part(metals.Metals).found, made.state.iteration = True, 100
    return made


@pytest.fixture
def made(start, tmp_path):
    return copied(start, tmp_path / "run")


def told(made):
    """Return which parts of the surface are told to be metal, to be paint, and are in doubt."""
    found = reckoning.reckon(made.state)
    weight = found.seen.pixels / found.seen.pixels.sum()
    sure = (2 * found.metal - 1).abs() > questions.DOUBTFUL
    metal, paint = sure & (found.metal > 0.5), sure & (found.metal < 0.5)
    return tuple(float(weight[which].sum()) for which in (metal, paint, ~sure))


@pytest.mark.parametrize("turn", [False, True])
@pytest.mark.parametrize("roughness", [-3.0, -1.0])
@pytest.mark.parametrize("albedo", [GREY, GOLD])
def test_a_metal_is_told(made, roughness, albedo, turn):
    show(made, metallic=6.0, roughness=roughness, albedo=albedo, turn=turn, lamp=DIM)
    metal, paint, _ = told(made)
    assert metal > 0.8 and paint < 0.05


@pytest.mark.parametrize(
    "albedo, roughness, exposure",
    [
        ([1.0, 1.0, 1.0], -1.0, EVEN),
        (ORANGE, -1.0, EVEN),
        (ORANGE, -2.5, EVEN),
        ([-4.0] * 3, -1.0, EVEN),
        (ORANGE, 6.0, EVEN),
        ([1.0, 1.0, 1.0], -1.0, UNEVEN),
        (ORANGE, 6.0, UNEVEN),
    ],
)
def test_paint_is_told(made, albedo, roughness, exposure):
    """Check white and orange paint, orange and black glaze, and matte orange, under lamps that are much brighter than the rest."""
    show(made, metallic=-6.0, roughness=roughness, albedo=albedo, exposure=exposure)
    metal, paint, _ = told(made)
    assert paint > 0.8 and metal < 0.02


def test_a_light_that_changes_does_not_make_metal(made):
    """Check a matte ball that is lit from another side in each photo, taken as one under a light that stands still."""
    state = made.state
    state.change("render.reflection", "none", "needs", "the test has a matte ball")
    show(made, metallic=-6.0, roughness=6.0, turn=True, lamps=LAMPS[:1])
    state.change("light.frame", "world", "photos", "the photos do not tell")
    state.change("render.reflection", "microfacet", "needs", "nor do they tell this")
    metal, paint, _ = told(made)
    assert metal < 0.02 and paint > 0.5


def test_what_no_photo_shows_is_not_told(made):
    show(made, metallic=6.0, roughness=-1.0)
    state = made.state
    state.photos[:] = [photo._replace(image=torch.full_like(photo.image, 255)) for photo in state.photos]
    found = reckoning.reckon(state)
    assert bool((found.metal == 0.5).all()) and not found.seen.exact.any() and found.seen.pixels.any()


def test_metals_have_few_colours():
    """Check metals and paints, each bright and in the shade."""
    paints = [(0.82, 0.47, 0.015), (0.55, 0.025, 0.015), (0.02, 0.14, 0.52), (0.1, 0.4, 0.1), (0.4, 0.22, 0.1)]
    for shade in (1.0, 0.1):
        assert bool((reckoning.from_metals(shade * torch.tensor(METALS)) < 0.002).all())
        assert bool((reckoning.from_metals(shade * torch.tensor(paints)) == reckoning.FOREIGN).all())
    assert float(reckoning.from_metals(torch.zeros(1, 3))) == 0.0


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
    clipped = torch.zeros_like(shown, dtype=torch.bool)
    seen = Seen(shown, clipped, weight, torch.full((count,), 48.0), shown.mean(dim=1), up, up)
    learned = torch.where(met[..., None], there, 0.2)
    near = neighbours(torch.rand(count, 3, generator=generator), NEIGHBOURS)
    fits = mirrored.fit_both(seen, (([each] * 3, which) for each, which in zip(learned, met, strict=True)), near)
    values = reckoning.terms(
        seen, fits, near, *reckoning.told_by_object(fits.of_object), *reckoning.mean_and_changes(seen, near)
    )
    values["changing light"] = torch.zeros(count)
    assert bool((reckoning.log_odds(values) > 0).all()) == bool((reckoning.log_odds(values) > 0).any()) == metal
    assert bool((fits.of_object.ratio < 0).all()) == metal
    if metal:
        assert torch.allclose(fits.of_object.reflectance, torch.tensor(reflectance), atol=0.03)


@pytest.mark.parametrize(
    ("diffuse", "reflectance", "metal"), [(0.0, 0.8, True), (0.6, 0.04, False), (0.99, 0.04, False)]
)
def test_photos_that_clip_a_surface_tell_what_it_is(diffuse, reflectance, metal):
    """Check that a surface which photos clip is told like one that they do not.

    The surfaces are a metal, bright paint and white paint. They mirror a radiance of 0.3 in a quarter of the photos, and of 1 to 4 in the
    others. There the metal is clipped more often than not, so the rest of its photos are nearly alike.
    """
    count, photos = 80, 24
    generator = torch.Generator().manual_seed(0)
    up = torch.tensor([0.0, 0.0, 1.0]).expand(count, photos, 3)
    light = 1 + 3 * torch.rand(photos, 1, 1, generator=generator)
    light[::4] = 0.3
    light = light.expand(photos, count, 3)
    shown = (diffuse + reflectance * light).transpose(0, 1)
    weight, pixels = torch.full((count, photos), 4.0), torch.full((count,), 96.0)
    near = neighbours(torch.rand(count, 3, generator=generator), NEIGHBOURS)
    met = torch.zeros(photos, count, dtype=torch.bool)

    def fit(clip):
        seen = Seen(shown.clamp_max(clip), shown > clip, weight, pixels, shown.mean(dim=1), up, up)
        fits = mirrored.fit_both(seen, (([each] * 3, which) for each, which in zip(light, met, strict=True)), near)
        return fits.everywhere, reckoning.terms(
            seen, fits, near, *reckoning.told_by_object(fits.of_object), *reckoning.mean_and_changes(seen, near)
        )

    (clipped, terms), (whole, all_terms) = fit(1.0), fit(math.inf)
    assert bool((clipped.ratio < 0).all()) == bool((clipped.ratio < 0).any()) == metal
    assert torch.allclose(clipped.ratio.clamp(-1, 1), whole.ratio.clamp(-1, 1), atol=0.3)
    if metal:
        assert torch.allclose(clipped.reflectance, torch.tensor(reflectance), atol=0.03)
        assert bool((terms["fall"] > 0.8).all()) and bool((all_terms["fall"] > terms["fall"]).all())


def test_wrong_normals_do_not_change_how_much_metals_reflect_on_the_whole():
    """Check a metal of 0.8 whose rays meet other points of the object than those it mirrors: least squares take it for darker."""
    count, photos = 400, 12
    generator = torch.Generator().manual_seed(0)
    up = torch.tensor([0.0, 0.0, 1.0]).expand(count, photos, 3)
    there = torch.rand(photos, count, 3, generator=generator)
    shown = 0.8 * there.transpose(0, 1)
    weight, clipped = torch.full((count, photos), 4.0), torch.zeros_like(shown, dtype=torch.bool)
    seen = Seen(shown, clipped, weight, torch.full((count,), 48.0), shown.mean(dim=1), up, up)
    near = neighbours(torch.rand(count, 3, generator=generator), NEIGHBOURS)
    met = torch.ones(photos, count, dtype=torch.bool)
    other = there[:, torch.randperm(count, generator=generator)]
    fit = mirrored.fit_both(seen, (([each] * 3, which) for each, which in zip(other, met, strict=True)), near).of_object
    level = fit.reflected / fit.white
    assert torch.allclose(level.mean(dim=0), torch.tensor(0.8), atol=0.02) and float(level.std()) < 0.05
    assert float(fit.reflectance.mean()) < 0.7


def test_metals_are_as_the_metals_around_them():
    points, normals, ball = ball_on_board()
    was = torch.where(ball & (points[:, 2] > 1), raw_metallic(0.98), raw_metallic(0.02))
    like = reckoning.like_metals(reckoned(points, normals, torch.where(ball, 0.99, 0.01), was))
    lower = like[ball & (points[:, 2] < 0.8)].mean(dim=0)
    assert lower[0] == pytest.approx(1 / (1 + math.exp(-2)), abs=0.05), "the base colour of the upper half"
    assert lower[3] == pytest.approx(1 / (1 + math.exp(3)), abs=0.05), "its roughness"


@pytest.mark.parametrize("metallic, by_object", [(0.02, False), (0.98, True)])
def test_metals_that_nothing_was_learned_of_are_as_they_fit(metallic, by_object):
    """Check metals that were paint so far, and metals whose reflectance photos of the object tell."""
    points, normals, ball = ball_on_board()
    was = torch.full((len(points),), raw_metallic(metallic))
    like = reckoning.like_metals(reckoned(points, normals, torch.where(ball, 0.99, 0.01), was, by_object))[ball]
    assert torch.allclose(like, torch.tensor([0.8, 0.8, 0.8, 0.2]).expand_as(like), atol=0.01)


def test_pieces_in_doubt_end_at_creases():
    """Check that a ball and the board that it stands on are two pieces, the larger one first, without what is not in doubt."""
    points, normals, ball = ball_on_board()
    found = reckoned(points, normals, torch.full((len(points),), 0.5), torch.zeros(len(points)))
    doubt = torch.where(ball & (points[:, 2] > 1.2), 0.1, 0.9)
    weight = torch.where(ball, 3.0, 1.0).numpy()
    first, second, *others = questions.pieces(found, doubt, weight)
    assert np.array_equal(first, (ball & (points[:, 2] <= 1.2)).numpy()) or np.array_equal(first, (~ball).numpy())
    assert np.array_equal(first | second, (doubt > 0.5).numpy()) and not others
    assert weight[first].sum() >= weight[second].sum()


def in_doubt(made, monkeypatch, metal=0.5):
    """Let photos leave open what all surfels are: `metal` is the probability."""

    def reckon(state):
        found = reckoning.reckon(state)
        return found._replace(metal=torch.full_like(found.metal, metal))

    monkeypatch.setattr(metals, "reckon", reckon)


def test_a_question_is_asked_about_what_photos_leave_open(made, monkeypatch):
    """Check the question about a ball that photos leave open, its picture, and that nothing is asked of one that photos show clearly."""
    show(made, metallic=6.0, roughness=-3.0, albedo=GOLD, lamp=DIM)
    write_asset(made.state)
    assert not (made.state.folder / "questions.json").exists()
    with monkeypatch.context() as patch:
        in_doubt(made, patch)
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
    write_asset(made.state)
    assert not (made.state.folder / "questions.json").exists() and not (made.state.folder / "questions").exists()


def test_how_much_of_the_surface_is_in_doubt_is_said(made, monkeypatch):
    show(made, metallic=6.0, roughness=-3.0, albedo=GOLD, lamp=DIM)
    doubt, facts, _ = metals.doubt(made.state)
    assert len(doubt) == made.state.learned.count and facts["part"] < 0.05
    in_doubt(made, monkeypatch)
    doubt, facts, _ = metals.doubt(made.state)
    assert facts["part"] > 0.9 and facts["what"] == made.state.decided["doubt"]
    assert facts["what"] == f"photos do not tell metal from paint on {facts['part']:.0%} of the surface"


def test_the_asset_has_the_doubt_of_the_surfels_that_are_written(made):
    show(made, metallic=6.0, roughness=-3.0, albedo=GOLD, lamp=DIM)
    position = made.state.learned["position"]
    position.data[0] = 0  # within the ball, so that no photo shows it
    doubt, facts, _ = metals.doubt(made.state)
    write_asset(made.state)
    splats = read_splats(made.state.folder / "splats.ply")
    row = {tuple(place): i for i, place in enumerate(position.tolist())}
    written = [row[tuple(place)] for place in splats.positions.tolist()]
    assert float(doubt[0]) == 1, "what no pixel shows is in doubt"
    assert 0 not in written and np.array_equal(splats.doubt, doubt.numpy()[written])
    assert json.loads((made.state.folder / "metrics.json").read_text())["doubt"] == facts


def test_metals_that_are_held_are_not_in_doubt(made, monkeypatch):
    show(made, metallic=6.0, roughness=-3.0, albedo=GOLD, lamp=DIM)
    in_doubt(made, monkeypatch)
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
    state.change("indirect.resolution", 96, "plan", "the test says so")
    shown = reckoning.reckon(state).shown
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
    assert "had been taken for paint" in state.decided["metals"]


@pytest.mark.parametrize(("metallic", "sharp"), [(6.0, metals.SHARP.metal), (-6.0, metals.SHARP.paint)])
def test_surfels_start_sharp(made, metallic, sharp):
    """Check that what was learned as rough starts over as sharp when metals are found, but not at later looks."""
    show(made, metallic=metallic, roughness=-3.0, albedo=GOLD, lamp=DIM)
    state = made.state
    shown = reckoning.reckon(state).shown
    put(made, roughness=0.0)
    do(state, "judge metals", 0.25, hidden=0.1)
    assert float(state.surfels().roughness.detach()[shown].median()) == pytest.approx(0.5)
    state.part(metals.Metals).found = False
    do(state, "find metals", 0.25, done=150)
    assert float(state.surfels().roughness.detach()[shown].median()) == pytest.approx(sharp)


def test_paint_that_was_taken_for_metal_becomes_paint(made):
    show(made, metallic=-6.0, roughness=-1.0)
    state = made.state
    put(made, metallic=raw_metallic(0.9))
    do(state, "judge metals", 0.25, hidden=0.1)
    shown = reckoning.reckon(state).shown
    assert float((state.surfels().metallic < 0.1)[shown].float().mean()) > 0.9


def test_only_the_first_mesh_of_a_quarter_is_judged(made, monkeypatch):
    judged = []
    monkeypatch.setitem(ACTIONS, "judge metals", lambda state, step: judged.append(step.done))
    made.state.change("indirect.every", 30, "plan", "the test says so")
    for done in range(30, 330, 30):
        do(made.state, "judge metals", 0.25, done=done, hidden=0.1)
    assert judged == [120, 210, 300]


@pytest.mark.parametrize("hidden, progress, held", [(None, 0.25, False), (0.1, 0.9, False), (0.1, 0.25, True)])
def test_materials_are_judged_with_new_meshes_unless_held(made, hidden, progress, held):
    """Check that nothing changes between meshes, when the residual learns, and where hints hold metals."""
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
    assert judged == [100], "a quarter of 400 iterations"


def test_metals_are_found_once(made):
    show(made, metallic=6.0, roughness=-1.0, lamp=DIM)
    state = made.state
    state.part(metals.Metals).found = False
    put(made, metallic=0.0)
    do(state, "find metals", 0.25, done=149)
    assert not state.part(metals.Metals).found and "metals" not in state.decided
    do(state, "find metals", 0.25, done=150)
    with torch.no_grad():
        metallic = activate(state.learned.constant | state.learned.by_row).metallic
    assert state.part(metals.Metals).found and float((metallic > metals.HELD.metal - 1e-3).float().mean()) > 0.5
    put(made, metallic=0.0)
    do(state, "find metals", 0.3, done=151)
    assert (state.learned["metallic"] == 0).all()


def test_propagation_finds_metals_by_itself(large_ball, tmp_path):
    made = small(large_ball, tmp_path / "run", *ALL, "propagation.every=20", total=400)
    show(made, metallic=6.0, roughness=-1.0)
    put(made, metallic=0.0)
    do(made.state, "find metals", 0.25, done=150)
    assert not made.state.part(metals.Metals).found and (made.state.learned["metallic"] == 0).all()


def test_what_is_told_does_not_learn(made):
    """Check that a ball of metal stays metal while everything else learns, and that halves of its surfels do, too."""
    show(made, metallic=6.0, roughness=-1.0, lamp=DIM)
    state = made.state
    put(made, metallic=0.0)
    do(state, "judge metals", 0.25, hidden=0.1)
    held = int(state.learned["told"].sum())
    assert held > 0.9 * int(reckoning.reckon(state).shown.sum())
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
    assert int((state.learned["metallic"] == raw_metallic(metals.HELD.metal)).sum()) > held + 0.5 * divided


@pytest.mark.parametrize("likely, kind", [(0.51, 0), (0.49, 1), (0.5, None)])
def test_metallic_is_held_at_the_likelier_kind_even_in_doubt(made, monkeypatch, likely, kind):
    in_doubt(made, monkeypatch, likely)
    put(made, metallic=raw_metallic(0.5))
    made.state.part(metals.Metals).found = True
    do(made.state, "judge metals", 0.25, hidden=0.1)
    value = raw_metallic(0.5 if kind is None else metals.HELD[kind])
    assert (made.state.learned["metallic"] == value).all()
    assert (made.state.learned["told"] == (kind is not None)).all()


@pytest.mark.parametrize(
    "likely, again, kind",
    [(0.7, True, None), (0.3, True, None), (0.8, True, 0), (0.2, True, 1), (0.7, False, 0), (0.3, False, 1)],
)
def test_metallic_learns_on_after_the_first_look_where_there_is_doubt(made, monkeypatch, likely, again, kind):
    """Check that what is in doubt is neither metal nor paint until the next look, if there will be one."""
    in_doubt(made, monkeypatch, likely)
    state = made.state
    put(made, metallic=0.0)
    state.change("indirect.every", 100 if again else state.total, "plan", "the test says so")
    state.part(metals.Metals).found = False
    do(state, "find metals", 0.25, done=150)
    value = torch.tensor(0.0 if kind is None else raw_metallic(metals.HELD[kind]))
    assert (state.learned["metallic"] == value).all()
    assert (state.learned["told"] == (kind is not None)).all()


def test_metals_are_judged_again_with_masks_meshes_and_time(made, monkeypatch):
    """Check 400 iterations with a mesh every 100: the residual learns from 340 on, and in a minute judging would take 300 of them."""
    state = made.state
    state.change("indirect.every", 100, "plan", "the test says so")
    state.iteration = 299
    assert metals_judged_again(state)
    state.iteration = 300
    assert not metals_judged_again(state)
    state.iteration, state.plan = 150, Plan(1.0)
    assert not metals_judged_again(state) and "judge metals" in state.plan.left_out
    state.plan = Plan(None)
    monkeypatch.setattr(State, "from_hull", False)
    assert not metals_judged_again(state)


def test_a_metallic_that_has_the_held_value_by_chance_still_learns(ball_capture, tmp_path):
    made = small(ball_capture, tmp_path / "run", "train.light_first=0", total=100)
    put(made, metallic=raw_metallic(metals.HELD.metal))
    made.state.part(metals.Metals).found = True
    before = made.state.learned["metallic"].detach().clone()
    put(made, held=torch.arange(len(before)) % 2 == 0)
    made.step()
    moved = made.state.learned["metallic"] != before
    assert not moved[::2].any() and moved[1::2].any()
