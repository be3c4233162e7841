"""Test that a finished training is continued with hints: parts that a user says are metal or paint."""

import json

import numpy as np
import pytest
import torch

from benchmarks.scenes.analytic import write_ball_capture
from refgs import train_job
from refgs.asked import Asked
from refgs.errors import InputError
from refgs.formats.hints import FILE, Hint, read_hints, write_hints
from refgs.formats.needs import Found
from refgs.formats.splats import read_splats
from refgs.model.surfels import raw_metallic
from refgs.run_folder import read_run_facts
from refgs.train.decide import needs
from refgs.train.hints import AGAIN, AT_MOST, continue_with_hints, hinted_kinds
from refgs.train.keep import checkpoint
from refgs.train.keep.asset import write_asset
from refgs.train.keep.measures import held_out_psnr
from refgs.train.learn.densify import densify
from refgs.train.material import metals
from tests.makers.training import TINY, put, trained, trainer

TOTAL = 300
METAL, PAINT = (torch.tensor(raw_metallic(metallic)) for metallic in metals.HELD)


def silent(event, facts):
    """Ignore an event."""


@pytest.fixture(scope="module")
def plastic(ball_capture, tmp_path_factory):
    """Train on photos of a metal ball, all of it held as paint. Return the Trainer, and the PSNR of held-out views.

    Afterwards, the paint is held no more.
    """
    made = trainer(ball_capture, tmp_path_factory.mktemp("runs") / "run", *TINY, total=TOTAL)
    metals.hold_as(made.state, torch.ones(made.state.learned.count, dtype=torch.long))
    made.run()
    write_asset(made.state)
    quality = held_out_psnr(made.state, most=9)
    put(made, metallic=-3.0)
    made.save()
    return made, quality


def of_splats(run, kind="metal", above=-np.inf) -> list[Hint]:
    """Make a hint about the splats of a run that are above this height."""
    positions = read_splats(run / "splats.ply").positions
    return [Hint(kind, positions[positions[:, 2] > above])]


def hint_file(run, **words):
    file = run.parent / f"{len(list(run.parent.iterdir()))}.json"
    write_hints(file, run, of_splats(run, **words))
    return file


def go_on(capture, out, run, file, *, minutes=None, attend=lambda state: False, resume=False):
    hinted = {"resume": True} if resume else {"run": run, "hints": file}
    return train_job.train(Asked(capture, out, None, "cpu", minutes, **hinted), silent, attend)


def count(state, raw) -> int:
    return int((state.learned["metallic"] == raw).sum())


def test_a_mirror_learned_as_plastic_becomes_metal(plastic, ball_capture, tmp_path):
    """Check that pictures are no worse once the ball is held as metal, and that base colour becomes its reflectance."""
    run, before = plastic[0].state.folder, plastic[1]
    state, quality = go_on(ball_capture, tmp_path / "new", run, hint_file(run))
    assert (state.surfels().metallic > 0.97).all()
    assert quality > before
    opaque = (state.surfels().opacities > 0.5).numpy()
    colour = state.surfels().albedo.detach().numpy()[opaque].mean(axis=0)
    assert colour[0] > 1.1 * colour[1] > 1.21 * colour[2]  # copper


def test_clay_learned_as_rough_metal_becomes_paint(tmp_path):
    write_ball_capture(tmp_path / "clay", 32, matte=True)
    made = trainer(tmp_path / "clay", tmp_path / "run", *TINY, "needs.specular=on", total=150)
    metals.hold_as(made.state, torch.zeros(made.state.learned.count, dtype=torch.long))
    made.run()
    write_asset(made.state)
    before = held_out_psnr(made.state, most=9)
    state, quality = go_on(
        tmp_path / "clay", tmp_path / "new", tmp_path / "run", hint_file(tmp_path / "run", kind="paint")
    )
    assert (state.surfels().metallic < 0.01).all()
    assert quality > before + 0.5


def test_what_was_not_hinted_learns(plastic, ball_capture, tmp_path):
    """Check a new run of which the upper half is hinted: its folder, its schedule, and what its surfels are at the end."""
    run, out = plastic[0].state.folder, tmp_path / "new"
    state, _ = go_on(ball_capture, out, run, hint_file(run, above=0.1))
    assert state.iteration == TOTAL and checkpoint.complete(out / "checkpoints") == [round(AGAIN * TOTAL), TOTAL]
    upper = state.learned["position"][:, 2].detach() > 0.2
    metallic = state.learned["metallic"].detach()
    assert (metallic[upper] == METAL).float().mean() > 0.97
    lower = metallic[state.learned["position"][:, 2].detach() < -0.2]
    assert (lower != METAL).float().mean() > 0.97 and len(lower.unique()) > 0.9 * len(lower)
    told = json.loads((out / FILE).read_text())
    assert told["run"] == str(run.resolve()) and len(told["hints"][0]["points"]) > 100
    assert read_run_facts(out)[1] == read_run_facts(run)[1]
    seconds = json.loads((out / "metrics.json").read_text())["training_seconds"]
    assert 0 < seconds < state.plan.spent


def test_hinted_halves_are_held_and_so_they_are_after_a_resume(plastic, ball_capture, tmp_path):
    run, out = plastic[0].state.folder, tmp_path / "new"
    file = tmp_path / "hints.json"
    write_hints(file, run, [*of_splats(run), *of_splats(run, "paint", above=0.0)])
    state, quality = go_on(ball_capture, out, run, file, attend=lambda state: state.iteration >= AGAIN * TOTAL + 10)
    assert quality is None and not state.ended
    metal, paint = count(state, METAL), count(state, PAINT)
    assert metal + paint == len(state.learned["metallic"]) and min(metal, paint) > 100
    gradient = torch.ones(metal + paint)
    with torch.no_grad():
        divided = densify(state.learned, gradient, state.settings.densify, 2 * len(gradient), divide=True)
    assert divided and count(state, METAL) + count(state, PAINT) == len(state.learned["metallic"])
    once = Asked(ball_capture, out, None, "cpu", run=run, hints=file)
    assert train_job.unfinished(once) is True
    state, quality = go_on(ball_capture, out, run, None, resume=True)
    assert state.ended and quality is not None
    assert train_job.unfinished(once) is None
    assert count(state, METAL) + count(state, PAINT) == len(state.learned["metallic"])


def test_a_surfel_is_what_the_nearest_splat_is(plastic):
    state = plastic[0].state
    positions = state.learned["position"].detach().numpy()
    splats = np.array([[0, 0, 2.0], [0, 0, -2.0], [0, 9.0, 0]])
    hints = [Hint("metal", splats[:2] + 0.1), Hint("paint", splats[1:2])]
    kinds = hinted_kinds(state, splats, hints).numpy()
    assert (kinds[positions[:, 2] > 0.01] == 0).all() and (kinds[positions[:, 2] < -0.01] == 1).all()
    assert (hinted_kinds(state, splats, hints[1:]).numpy()[positions[:, 2] > 0.01] == -1).all()


def test_metals_come_back_to_a_scene_that_was_taken_for_matte(ball_capture, tmp_path):
    made = trainer(ball_capture, tmp_path / "run", *TINY, total=40)
    made.state.needs["specular"] = Found(needed=False, why="the test says so")
    needs.SPECULAR.apply(made.state, made.state.needs["specular"])
    made.run()
    write_asset(made.state)
    assert "metallic" not in made.state.learned
    again = trainer(ball_capture, tmp_path / "again", *TINY, total=40)
    continue_with_hints(again.state, made.state.folder, of_splats(made.state.folder))
    assert count(again.state, METAL) == again.state.learned.count
    assert again.state.settings.render.reflection == "microfacet"
    again.run()
    assert again.state.ended and count(again.state, METAL) > 0


def test_a_time_shortens_what_is_repeated(plastic, ball_capture, tmp_path):
    run, total = plastic[0].state.folder, []
    go_on(
        ball_capture,
        tmp_path / "new",
        run,
        hint_file(run),
        minutes=0.05,
        attend=lambda state: total.append((state.iteration, state.total)) or len(total) > 1,
    )
    first, whole = total[0]
    assert abs(first / whole - AGAIN) < 0.1


def test_what_would_take_too_long_is_shortened(ball_capture, tmp_path):
    """Check that a time is set where none is asked for, and that the run's own seconds do not count for it."""
    made = trained(ball_capture, tmp_path / "slow", *TINY, total=12)
    made.state.seconds = 600.0
    made.save()
    again = trainer(ball_capture, tmp_path / "again", *TINY, total=12)
    continue_with_hints(again.state, made.state.folder, of_splats(made.state.folder))
    assert again.state.plan.minutes == AT_MOST and again.state.plan.spent < 60
    assert again.state.total - again.state.iteration == pytest.approx(60 * AT_MOST / (600 / 12), abs=2)


def test_what_cannot_be_continued(plastic, ball_capture, tmp_path):
    run, file = plastic[0].state.folder, hint_file(plastic[0].state.folder)
    dull = trained(ball_capture, tmp_path / "dull", *TINY, "needs.specular=off", total=12)
    with pytest.raises(InputError, match="settings that leave out metals"):
        go_on(ball_capture, tmp_path / "new", dull.state.folder, hint_file(dull.state.folder))
    assert not (tmp_path / "new").exists()
    for checkpoints in (dull.state.folder / "checkpoints").iterdir():
        checkpoints.unlink()
    with pytest.raises(InputError, match="has no checkpoint to continue from"):
        go_on(ball_capture, tmp_path / "new", dull.state.folder, file)
    with pytest.raises(InputError, match="keeps its settings"):
        Asked(ball_capture, tmp_path / "new", changes=tuple(TINY), run=run, hints=file)
    with pytest.raises(InputError, match="holds another run"):
        go_on(ball_capture, dull.state.folder, run, file)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("metal", "not JSON"),
        ('{"hints": []}', "at least 1 item"),
        ('{"hints": [{"kind": "metal"}]}', "hints.0.points is missing"),
        ('{"hints": [{"kind": "wood", "points": [[0, 0, 0]]}]}', "hints.0.kind should be 'metal' or 'paint'"),
        ('{"hints": [{"kind": "metal", "points": []}]}', "hints.0.points is wrong: .* at least 1 item"),
        ('{"hints": [{"kind": "metal", "points": [[0, 0, NaN]]}]}', "hints.0.points.0.2 should be a finite number"),
        ('{"hints": [{"kind": "metal", "points": [[0, 0]]}]}', "hints.0.points.0.2 is missing"),
    ],
)
def test_a_file_that_has_no_hints(tmp_path, text, says):
    (tmp_path / "hints.json").write_text(text)
    with pytest.raises(InputError, match=says):
        read_hints(tmp_path / "hints.json")
