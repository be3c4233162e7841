"""Test that the add-on starts the trainer's processes and follows their output. A fake worker stands in for the trainer."""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from refgs_addon import jobs
from refgs_addon.errors import InputError
from refgs_addon.trainer import commands
from tests.makers.waiting import final_state, until


@pytest.fixture
def start(python, tmp_path):
    def start(name="good", out="run", mesh=True, **words):
        capture = tmp_path / f"{name} photos"
        capture.mkdir(exist_ok=True)
        asked = commands.Asked(capture, tmp_path / out, **words)
        return commands.train(python, asked, tmp_path / "logs" / f"{out}.txt", mesh)

    return start


def test_a_training_to_its_end(start, tmp_path):
    job = start(preset="quick", minutes=2.0, settings={"train.seed": 3}, mesh=False)
    assert final_state(job) == "done" and job.results["train"]["psnr"] == 30
    assert job.progress["iteration"] == 1000 and len(job.curve) == 100 and job.curve[-1] == (10.0, 30.0)
    assert job.held_out == [(1.0, 20.0), (10.0, 29.0)]
    asked = json.loads((tmp_path / "run" / "started").read_text())
    assert asked["settings"] == ["train.seed=3"] and asked["minutes"] == 2.0 and asked["preset"] == "quick"
    assert jobs.run_state(tmp_path / "run") == "finished"
    assert job._process.wait(timeout=10) == 0


def test_a_job_is_found_when_an_earlier_one_is_dismissed(start):
    first, second = start(out="a", mesh=False), start(out="b", mesh=False)
    assert jobs.find(first.serial) is first and jobs.find(second.serial) is second
    jobs.JOBS.remove(first)
    assert jobs.find(second.serial) is second
    for gone in (first.serial, 0):
        with pytest.raises(InputError, match="no longer in the list"):
            jobs.find(gone)
    jobs.JOBS.append(first)


def test_a_training_with_hints_keeps_the_settings_of_the_run(start, tmp_path):
    job = start(hinted=(tmp_path / "old", tmp_path / "hints.json"), mesh=False)
    assert final_state(job) == "done"
    asked = json.loads((tmp_path / "run" / "started").read_text())
    told = {"from": str(tmp_path / "old"), "hints": str(tmp_path / "hints.json")}
    assert asked == {"command": "train", "capture": job.commands[0]["capture"], "out": str(job.run)} | told


def test_one_that_is_silent_is_not_waited_for(tmp_path):
    """Check that `poll` returns at once for a job whose process still runs but has closed its output."""
    ends_with_its_input = "import os, sys; print('{}', flush=True); os.close(1); sys.stdin.read(); os._exit(3)"
    arguments, commands = ("-c", ends_with_its_input), [{"command": "rest"}]
    job = jobs.add(jobs.Job("slow", Path(sys.executable), commands, tmp_path / "log.txt", arguments=arguments))
    until(lambda: job._output_closed)
    assert not jobs.poll() and not job.ended and job._process.poll() is None
    job.close_input()
    assert final_state(job) == "failed" and "status 3" in job.line


def test_it_rests_while_it_is_paused(start):
    job = start(mesh=False)
    until(lambda: job.progress)
    job.tell("pause")
    until(lambda: job.state == "paused")
    before = job.progress["iteration"]
    time.sleep(0.1)
    assert not jobs.poll() and job.progress["iteration"] == before
    job.tell("resume")
    until(lambda: job.progress["iteration"] > before)
    job.tell("stop")
    assert final_state(job) == "done"


def test_one_at_a_time_and_the_next_after_it(start):
    first, second, third = start(out="a", mesh=False), start(out="b", mesh=False), start(out="c", mesh=False)
    until(lambda: first.progress)
    assert second.state == third.state == "waiting"
    third.stop()
    assert third.state == "cancelled"
    until(lambda: second.progress)
    assert first.state == "done"
    assert final_state(second) == "done" and third.state == "cancelled" and not third.progress


def test_one_that_is_stopped_can_be_gone_on_with(start, tmp_path):
    job = start()
    until(lambda: job.progress)
    job.stop()
    assert final_state(job) == "cancelled" and jobs.run_state(job.run) == "stopped"
    with pytest.raises(InputError, match="not empty"):
        start()
    again = start(resume=True, mesh=False)
    assert final_state(again) == "done" and json.loads((tmp_path / "run" / "started").read_text())["resume"]


def test_one_that_is_kept_goes_on_when_blender_closes(start, tmp_path):
    job, waiting = start(), start(out="waits")
    until(lambda: job.progress)
    assert jobs.trainings() == [job, waiting]
    jobs.keep_all(True)
    jobs.stop_all()
    assert not jobs.JOBS and jobs.run_state(job.run) == "training"
    assert job._process.wait(timeout=20) == 0
    assert jobs.run_state(job.run) == "finished" and (job.run / "mesh asked for").exists()
    assert not waiting.run.exists()


def test_one_that_is_kept_no_longer(start):
    job = start(mesh=False)
    until(lambda: job.progress)
    job.keep(True)
    job.tell("pause")
    until(lambda: job.state == "paused")
    job.stop()
    assert final_state(job) == "cancelled" and job._process.wait(timeout=20) == 0
    assert jobs.run_state(job.run) == "stopped"


BLENDER = """
import sys, time
from pathlib import Path
from refgs_addon import jobs
from refgs_addon.trainer import commands
python, capture, out, kept = sys.argv[1:]
job = commands.train(Path(python), commands.Asked(Path(capture), Path(out)), Path(out + ".txt"), mesh=False)
job.keep(kept == "kept")
asked = False  # once: an answer to a second request may find Blender gone, and would end the trainer before its checkpoint
while job.state != "paused":
    if job.progress and not asked:
        job.tell("pause")
        asked = True
    jobs.poll()
    time.sleep(0.05)
print("paused", flush=True)
time.sleep(600)
"""


@pytest.fixture
def killed(python, tmp_path):
    """Return a function that simulates a crash of Blender during a paused training. That function returns the training's run folder."""

    def killed(kept: str) -> Path:
        capture, run = tmp_path / "slow photos", tmp_path / "run"
        capture.mkdir()
        words = [sys.executable, "-c", BLENDER, python, capture, run, kept]
        with subprocess.Popen(words, stdout=subprocess.PIPE, cwd=Path(__file__).resolve().parents[2]) as blender:
            assert blender.stdout.readline() == b"paused\n"
            blender.kill()
        return run

    return killed


def test_a_blender_that_is_killed_leaves_nothing_running(killed):
    run = killed("not kept")
    until(lambda: jobs.run_state(run) == "stopped")
    with pytest.raises(InputError, match="not being trained"):
        jobs.stop_run(run)


@pytest.mark.parametrize(
    "text", ["[" * 50_000, "[]", '{"iteration": 1, "total": 2, "seconds_left": NaN}', '{"total": "x"}']
)
def test_a_broken_progress_is_none(tmp_path, text):
    (tmp_path / jobs.PROGRESS).write_text(text)
    assert jobs.run_progress(tmp_path) == {}


def test_a_training_that_a_killed_blender_left_is_found_and_stopped(killed):
    run = killed("kept")
    before = jobs.run_progress(run)["iteration"]
    until(lambda: jobs.run_progress(run).get("iteration", 0) > before)
    assert jobs.run_state(run) == "training" and not jobs.stop_requested(run)
    jobs.stop_run(run)
    assert jobs.stop_requested(run)
    until(lambda: jobs.run_state(run) == "stopped")


def test_the_same_folder_twice(start):
    start()
    with pytest.raises(InputError, match="being trained already"):
        start()


def test_what_fails_is_said_and_what_was_done_before_it_stays(start):
    job = start(mesh=True)
    assert final_state(job) == "failed" and job.line == "the mesh is crumbs" and "train" in job.results
    assert job.progress["psnr"] == 30  # the mesh's progress does not replace it in the panel
    assert job.fraction == 0.4


def test_a_trainer_that_dies(start):
    job, next_one = start("crash", out="a"), start(out="b", mesh=False)
    assert final_state(job) == "failed" and "status 3" in job.line and job.log.exists()
    until(lambda: next_one.state == "done")


def test_a_trainer_that_the_system_kills(start):
    job = start("slow", mesh=False)
    until(lambda: job.progress)
    job._process.kill()
    assert final_state(job) == "failed" and "memory was full" in job.line and "\n" not in job.line


def test_a_trainer_that_is_newer(start, monkeypatch):
    monkeypatch.setenv("FAKE", "newer")
    job = start()
    assert final_state(job) == "failed" and "9.9, is newer than this add-on" in job.line


def test_a_line_that_is_no_event(start):
    job = start("noise", mesh=False)
    assert final_state(job) == "done" and job.warnings == [
        "this is no JSON", "not an event: 5", "not an event: {'event': 'progress'}",
    ]  # fmt: skip


def test_a_python_that_is_not_there(start, tmp_path):
    job = commands.query_trainer(tmp_path / "nothing", tmp_path / "log.txt")
    assert job.state == "failed" and "cannot be started" in job.line and "preferences" in job.line


def test_a_python_without_the_trainer(tmp_path):
    job = commands.query_trainer(sys._base_executable, tmp_path / "log.txt")
    assert final_state(job) == "failed" and "log" in job.line


def test_cameras_are_found_then_checked(python, tmp_path):
    capture = tmp_path / "bare photos"
    capture.mkdir()
    checked = commands.check(python, capture, tmp_path / "found", tmp_path / "check.txt")
    assert final_state(checked) == "failed" and checked.no_cameras
    found = commands.find_cameras(python, capture, tmp_path / "found", tmp_path / "poses.txt")
    assert final_state(found) == "done" and found.progress["stage"] == "matching" and not found.curve
    assert found.results["poses"]["placed"] == 3 and found.results["check"]["lines"][0] == "Views: 3"


def test_asking_and_checking_run_beside_a_training(start, python, tmp_path):
    training = start()
    asked = commands.query_trainer(python, tmp_path / "log.txt")
    checked = commands.check(python, tmp_path, tmp_path / "found", tmp_path / "check.txt")
    assert final_state(asked) == final_state(checked) == "done" and asked.ready["refgs"] == "9.9"
    assert checked.results["check"]["lines"] == ["Views: 3", "Warning: they are dark"]
    assert training.state != "waiting"
