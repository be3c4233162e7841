"""Test commands that a scheduler repeats: `--once` does only what is left to do, and exit statuses say whether a retry helps."""

import os
import signal
import subprocess
import sys
import time

import pytest

from refgs import commands, train_job
from refgs.asked import Asked
from refgs.errors import InputError, TryAgain
from refgs.lock import LOCK, RunLock
from refgs.train.keep import checkpoint
from tests.makers.captures import colmap
from tests.makers.training import TINY

WORDS = [*TINY, "environment.resolution=16", "train.iterations=100000", "mesh.resolution=32", "mesh.triangles=500"]


def train(capture, out, changes=WORDS, minutes=0.05):
    commands.train(Asked(capture, out, "quick", "cpu", minutes, tuple(changes)), once=True)


def contents(run) -> dict:
    return {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}


@pytest.mark.skipif(os.name == "nt", reason="needs POSIX signals")
@pytest.mark.parametrize("end", ["SIGTERM", "input"])
def test_a_terminated_training_says_try_again(ball_capture, tmp_path, end):
    """Terminate a training by a signal, or by closing its input. Check that it leaves a checkpoint, and ends when it is repeated."""
    out = tmp_path / "run"
    command = [sys.executable, "-m", "refgs.cli", "train", str(ball_capture), "--out", str(out), "--preset", "quick"]
    command += ["--device", "cpu", "--once", *(word for change in WORDS for word in ("--set", change))]
    environment = os.environ | ({"REFGS_END_WITH_INPUT": "1"} if end == "input" else {})
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, env=environment)
    deadline = time.monotonic() + 240
    while not (out / "progress.json").exists():
        assert process.poll() is None and time.monotonic() < deadline, process.stderr.read()
        time.sleep(0.1)
    if end == "SIGTERM":
        process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=120)  # which closes the input
    assert process.returncode == 75, errors
    assert "Traceback" not in errors
    assert checkpoint.complete(out / "checkpoints")
    if end == "SIGTERM":
        train(ball_capture, out)
        assert (out / "splats.ply").exists()


def test_each_step_is_done_once(ball_capture, tmp_path, capsys):
    """Repeat each step of a run. Check that the second time says so and changes no file."""
    run = tmp_path / "run"
    for step in (
        lambda: commands.poses(ball_capture, once=True),
        lambda: commands.masks(ball_capture, [], once=True),
        lambda: train(ball_capture, run),
        lambda: commands.evaluate(run, "test", None, once=True),
        lambda: commands.export(run, texture=64, once=True),
    ):
        step()
        before, _ = contents(run), capsys.readouterr()
        step()
        assert capsys.readouterr().out.startswith("done before: ") and contents(run) == before
    for step in (lambda: train(ball_capture, run), lambda: commands.export(run, once=True)):
        (run / LOCK).touch()  # of a process that was killed when it had done its work
        step()
        assert contents(run) == before
    with pytest.raises(InputError, match=r"trained with train\.iterations = 100000, and not 90000"):
        train(ball_capture, run, [*WORDS, "train.iterations=90000"])
    with pytest.raises(InputError, match=r"trained by quick, not for 1 minutes"):
        commands.train(Asked(ball_capture, run, None, "cpu", 1), once=True)


def test_textures_of_a_killed_export_do_not_stop_the_next(ball_capture, tmp_path):
    run = tmp_path / "run"
    train(ball_capture, run)
    (run / "textures").mkdir()
    commands.export(run, texture=64, once=True)
    assert (run / "mesh.glb").exists()


def test_a_run_in_use_says_try_again(ball_capture, tmp_path):
    run = tmp_path / "run"
    asked = Asked(ball_capture, run, "quick", "cpu", changes=tuple(WORDS))
    train_job.train(asked, lambda event, facts: None, lambda state: state.iteration == 1)
    with RunLock(run), pytest.raises(TryAgain, match="is in use"):
        train(ball_capture, run)


def test_poses_are_searched_where_there_are_none(tmp_path):
    photos = colmap(tmp_path / "photos", count=2)
    (photos / "sparse").rename(tmp_path / "away")
    with pytest.raises(InputError, match="2 photos"):
        commands.poses(photos, once=True)
