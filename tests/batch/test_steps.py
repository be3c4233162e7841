"""Test how a step of a batch ends: done, failed for good, or to be tried again."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from refgs.batch.batch import _settled
from refgs.batch.steps import Outcome, Step, TryLater, recorded, run_step
from refgs.train.keep import checkpoint
from tests.makers.captures import nerfstudio
from tests.makers.disk import fill
from tests.makers.processes import commands
from tests.makers.training import TINY


def step(tmp_path, *words) -> Step:
    return Step(words[0], "cup", tuple(map(str, words)), tmp_path / "logs" / "cup" / f"{words[0]}.log")


def test_a_capture_is_complete_where_its_files_change_no_more_whatever_the_clock_says(tmp_path):
    (tmp_path / "a.png").touch()
    assert not _settled(tmp_path)
    for moved in (-3600, 3600):  # a clock that goes back dates files into the future
        for path in (tmp_path / "a.png", tmp_path):
            os.utime(path, (time.time() + moved,) * 2)
        assert _settled(tmp_path)


def test_a_step_is_recorded_and_known_again(tmp_path):
    capture = nerfstudio(tmp_path / "cup", 8)
    done = step(tmp_path, "poses", capture, "--once")
    outcome = run_step(done, 1, 0.0, None, ())
    assert outcome.status == 0 and outcome.seconds > 0 and outcome.what == ""
    assert f"$ refgs poses {capture} --once\ndone before" in done.log.read_text() and not done.running.exists()
    assert recorded(done)[:3] == outcome[:3]
    assert recorded(done._replace(words=("poses", "elsewhere"))) is None
    assert recorded(done._replace(made=tmp_path / "cameras")) is None
    done.log.with_suffix(".json").write_text("{")
    assert recorded(done) is None


def test_wrong_input_is_not_tried_again(tmp_path):
    outcome = run_step(step(tmp_path, "evaluate", tmp_path / "none"), 1, 0.0, None, ())
    assert outcome.status == 2 and outcome.what.startswith(f"{tmp_path / 'none'} is not a run folder")
    assert json.loads((tmp_path / "logs" / "cup" / "evaluate.json").read_text())["status"] == 2


@pytest.mark.parametrize(
    ("before", "may_fail", "runs"),
    [(0, False, True), (2, False, False), (2, True, True), (None, False, False)],
)
def test_a_step_follows_others(tmp_path, before, may_fail, runs):
    wrong = step(tmp_path, "trian")
    outcome = run_step(wrong, 1, 0.0, None, (may_fail,), Outcome(before))
    assert (outcome.status, wrong.log.exists()) == ((2, True) if runs else (None, False))


def test_a_full_disk_is_tried_again(tmp_path, small_disk):
    """Check that a step whose log cannot be written asks for another try, and so does one whose command cannot print."""
    there = step(small_disk, "poses", nerfstudio(tmp_path / "cup", 8), "--once")
    there.log.parent.mkdir(parents=True)
    there.log.touch()
    fill(small_disk / "filler")
    with pytest.raises(TryLater, match="No space left"):
        run_step(there, 1, 0.0, None, ())
    with open(small_disk / "filler", "r+b") as file:
        file.truncate(file.seek(0, os.SEEK_END) - 4096)  # room for the command's own line, and not for what it says
    there.log.write_bytes(bytes(4096 - len(f"$ refgs {' '.join(there.words)}\n")))
    with pytest.raises(TryLater, match="75"):
        run_step(there, 1, 0.0, None, ())
    (small_disk / "filler").unlink()
    assert run_step(there, 1, 0.0, None, ()).status == 0


def test_a_log_that_is_moved_away_is_tried_again(tmp_path, monkeypatch):
    done = step(tmp_path, "poses", nerfstudio(tmp_path / "cup", 8), "--once")

    def call(step, cores, log):
        step.log.parent.rename(tmp_path / "elsewhere")
        return 0, ""

    with monkeypatch.context() as patched, pytest.raises(TryLater, match=r"cannot be read or written \(No such file"):
        patched.setattr("refgs.batch.steps._call", call)
        run_step(done, 1, 0.0, None, ())
    assert run_step(done, 1, 0.0, None, ()).status == 0


def test_modules_beside_the_captures_are_not_imported(tmp_path, monkeypatch):
    """Check a step, and the children that it would start, in a folder with modules of the trainer's names."""
    for name in ("typer", "multiprocessing", "numpy"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'a').write({name!r})")
    capture = nerfstudio(tmp_path / "cup", 8)
    monkeypatch.chdir(tmp_path)
    assert run_step(step(tmp_path, "poses", capture, "--once"), 1, 0.0, None, ()).status == 0
    code = "import multiprocessing, os\nif __name__ == '__main__':\n"
    code += " from refgs import cli\n import sys\n sys.argv = ['refgs', '--version']\n"
    code += " try: cli.main()\n except SystemExit: pass\n"
    code += " multiprocessing.get_context('spawn').Process(target=os.getpid).start()\n"
    (tmp_path / "programs").mkdir()
    (tmp_path / "programs" / "start.py").write_text(code)  # as bin/refgs, which does not lie beside the captures
    done = subprocess.run([sys.executable, "programs/start.py"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "imported").exists()


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")
@pytest.mark.parametrize("victim", ["the command", "the worker"])
def test_a_killed_command_is_tried_again(ball_capture, tmp_path, victim):
    """Kill a training, or the process that started it. Check that the step asks for another try, and that no process is left."""
    words = ["train", ball_capture, "--out", tmp_path / "run", "--preset", "quick", "--device", "cpu", "--once"]
    words += [word for change in (*TINY, "train.iterations=100000") for word in ("--set", change)]
    work = multiprocessing.get_context("spawn").Process(target=_run, args=(step(tmp_path, *words), tmp_path / "said"))
    work.start()
    while not (tmp_path / "run" / "progress.json").exists():
        assert work.is_alive()
        time.sleep(0.1)
    [(command, parent)] = commands("refgs.cli train", str(tmp_path))
    assert parent == work.pid
    os.kill(command if victim == "the command" else parent, signal.SIGKILL)
    work.join()
    if victim == "the command":
        assert (tmp_path / "said").read_text() == "killed by signal 9"
    while commands("refgs.cli train", str(tmp_path)):
        time.sleep(0.1)
    assert victim == "the command" or checkpoint.complete(tmp_path / "run" / "checkpoints")
    assert not (tmp_path / "logs" / "cup" / "train.json").exists()


def _run(step: Step, said: Path) -> None:
    try:
        run_step(step, 1, 0.0, None, ())
    except TryLater as error:
        said.write_text(str(error))
