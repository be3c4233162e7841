"""Test trainings that are killed, or that cannot write: resumed, they end with the same files as a training that was left alone."""

import json
import multiprocessing
import os
import random
import shutil
import sys
import time
from collections import Counter
from fnmatch import fnmatch

import pytest

from refgs import cli, train_job
from refgs.errors import InputError, TryAgain
from tests.makers.training import TINY

CHANGES = [*TINY, "environment.resolution=16", "train.iterations=30", "train.checkpoint_every=8", "densify.every=10"]
CHANGES += ["light.exposure=on", "indirect.start=0.2", "indirect.every=8", "indirect.resolution=32"]
CHANGES += ["needs.reflections=on"]


class Killed(BaseException):
    """Raised in place of a signal: nothing that runs may catch it."""


def train(capture, run, attend=lambda state: False, resume=False):
    changes = [] if resume else CHANGES
    said = []
    words = capture, run, None if resume else "quick", "cpu", None, changes, resume
    train_job.train(*words, lambda event, facts: said.append((event, facts.get("what", ""))), attend)
    return said


def files(run):
    """Read the files of a run, by their paths. Without what says seconds, and without log.txt, of a fault before the resume."""
    found = {file.relative_to(run).as_posix(): file for file in run.rglob("*") if not file.is_dir()}
    timed = {"metrics.json", "history.jsonl", *(name for name in found if fnmatch(name, "checkpoints/*.toml"))}
    read = {name: None if name in timed else file.read_bytes() for name, file in found.items() if name != "log.txt"}
    needs = json.loads(read["needs.json"])
    return read | {"needs.json": [{k: v for k, v in row.items() if k not in ("seconds", "saved")} for row in needs]}


def check_same(run, whole):
    """Check that two runs have the same files, with the same contents apart from seconds, and as many lines of history."""
    got, expected = files(run), files(whole)
    assert got.keys() == expected.keys()
    assert [name for name in expected if got[name] != expected[name]] == []
    lines = [(folder / "history.jsonl").read_text().count("\n") for folder in (run, whole)]
    assert lines[0] == lines[1]


@pytest.fixture(scope="module")
def whole(ball_capture, tmp_path_factory):
    """Train without a disturbance, and return the run's folder."""
    run = tmp_path_factory.mktemp("whole") / "run"
    train(ball_capture, run)
    return run


@pytest.mark.parametrize("name", ["occluder.ply", "needs.json", "splats.ply"])
def test_a_result_that_could_not_be_written_is_written_by_a_resume(ball_capture, whole, tmp_path, name):
    run = tmp_path / "run"

    def block(state):  # a file cannot replace a folder
        if state.iteration == state.total - 1:
            (run / name).unlink(missing_ok=True)
            (run / name).mkdir()
        return False

    with pytest.raises(TryAgain, match="directory"):
        train(ball_capture, run, block)
    (run / name).rmdir()
    assert not (run / "splats.ply").exists()
    assert ("stage", "resumed at iteration 30") in train(ball_capture, run, resume=True)
    check_same(run, whole)


def kill_at(iteration):
    def kill(state):
        if state.iteration == iteration:
            raise Killed
        return False

    return kill


def test_killed_before_its_first_checkpoint_it_starts_over(ball_capture, whole, tmp_path):
    run = tmp_path / "run"
    with pytest.raises(Killed):
        train(ball_capture, run, kill_at(5))
    assert ("stage", "there is no checkpoint to resume from: starting over") in train(ball_capture, run, resume=True)
    check_same(run, whole)


def test_killed_before_its_first_checkpoint_it_makes_room_for_a_new_training(ball_capture, whole, tmp_path):
    run = tmp_path / "run"
    with pytest.raises(Killed):
        train(ball_capture, run, kill_at(5))
    train(ball_capture, run)
    check_same(run, whole)


def test_a_training_that_has_learned_something_makes_no_room(ball_capture, tmp_path):
    run = tmp_path / "run"
    with pytest.raises(Killed):
        train(ball_capture, run, kill_at(11))
    with pytest.raises(InputError, match="holds another run"):
        train(ball_capture, run)
    for file in (run / "checkpoints").glob("*.toml"):
        file.rename(file.with_name(file.name + ".damaged"))
    with pytest.raises(InputError, match="holds another run"):
        train(ball_capture, run)


def test_a_damaged_checkpoint_and_history_cost_a_line_each(ball_capture, whole, tmp_path):
    run = tmp_path / "run"
    with pytest.raises(Killed):
        train(ball_capture, run, kill_at(20))
    (run / "checkpoints" / "00000016.toml").write_text("")
    with open(run / "history.jsonl", "ab") as file:
        file.write(b'\xff\n{"iteration": "ten"}\n{"iteration": 1')
    said = train(ball_capture, run, resume=True)
    warnings = [what for event, what in said if event == "warning"]
    assert len(warnings) == 2 and "iteration 16 is damaged and set aside" in warnings[0]
    assert warnings[1] == "history.jsonl has damaged lines, which are left out: 3"
    assert ("stage", "resumed at iteration 8") in said
    for file in (run / "checkpoints").glob("*.damaged"):
        file.unlink()
    check_same(run, whole)


def command(capture, run):
    """Run `refgs train --once` as the command line does, in a process of its own."""
    changes = [word for change in CHANGES for word in ("--set", change)]
    sys.argv = ["refgs", "train", str(capture), "--out", str(run), "--once", "--preset", "quick", "--device", "cpu"]
    sys.argv += changes
    with open(run.with_suffix(".said"), "a") as said:
        os.dup2(said.fileno(), 1)
        os.dup2(said.fileno(), 2)
        cli.main()


def stage(run):
    """Say how far a training that was killed had come, by the files that it has written."""
    files = "splats.ply", "environment.exr", "checkpoints/*.toml", "run.toml"
    stages = "after its end", "writing results", "training", "before a checkpoint"
    return next((name for file, name in zip(files, stages, strict=True) if any(run.glob(file))), "reading photos")


KILLS = [3, pytest.param(int(os.environ.get("REFGS_KILLS", "30")), marks=pytest.mark.slow)]


@pytest.mark.skipif(os.name == "nt", reason="needs a fork server")
@pytest.mark.parametrize("kills", KILLS)
def test_killed_at_random_moments_it_ends_the_same(ball_capture, whole, tmp_path, kills):
    """Kill `refgs train` at random moments between its start and its end. Start it again until it has ended, and compare its files.

    Do so until it was killed `kills` times. The environment variable REFGS_KILLS sets this number for the slow test.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["refgs.train.trainer", "refgs.commands"])
    run, moments, killed, ended, longest = tmp_path / "run", random.Random(kills), 0, 0, None
    found = Counter()
    while killed < kills or run.exists():
        begun = time.monotonic()
        process = context.Process(target=command, args=(ball_capture, run))
        process.start()
        process.join(moments.uniform(0, longest) if longest and killed < kills else None)
        if process.exitcode is None:
            process.kill()
            process.join()
            killed += 1
            found[stage(run)] += 1
            continue
        assert process.exitcode == 0, run.with_suffix(".said").read_text()
        check_same(run, whole)
        shutil.rmtree(run)
        ended, longest = ended + 1, longest or time.monotonic() - begun
    print(f"{killed} kills, {dict(found)}; {ended} trainings ended with the same files")
