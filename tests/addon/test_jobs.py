"""Following the trainer's processes, by one that only speaks as it does."""

import json
import time

import pytest

from refgs_addon import jobs
from refgs_addon.errors import InputError
from tests.addon.waiting import until


@pytest.fixture
def start(python, tmp_path):
    def start(name="good", out="run", **words):
        capture = tmp_path / f"{name} photos"
        capture.mkdir(exist_ok=True)
        return jobs.train(python, capture, tmp_path / out, tmp_path / "logs" / f"{out}.txt", **words)

    return start


def test_a_training_to_its_end(start, tmp_path):
    job = start(preset="quick", minutes=2.0, settings={"train.seed": 3}, mesh=False)
    until(lambda: job.ended)
    assert job.state == "done" and job.results["train"]["psnr"] == 30
    assert job.progress["iteration"] == 1000 and len(job.curve) == 100 and job.curve[-1] == (10.0, 30.0)
    asked = json.loads((tmp_path / "run" / "started").read_text())
    assert asked["settings"] == ["train.seed=3"] and asked["minutes"] == 2.0 and asked["preset"] == "quick"
    assert jobs.run_state(tmp_path / "run") == "finished"
    assert job._process.wait(timeout=10) == 0


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
    until(lambda: job.ended)
    assert job.state == "done"


def test_one_at_a_time_and_the_next_after_it(start):
    first, second, third = start(out="a", mesh=False), start(out="b", mesh=False), start(out="c", mesh=False)
    until(lambda: first.progress)
    assert second.state == third.state == "waiting"
    third.stop()
    assert third.state == "cancelled"
    until(lambda: second.progress)
    assert first.state == "done"
    until(lambda: second.ended)
    assert third.state == "cancelled" and not third.progress


def test_one_that_is_stopped_can_be_gone_on_with(start, tmp_path):
    job = start()
    until(lambda: job.progress)
    job.stop()
    until(lambda: job.ended)
    assert job.state == "cancelled" and jobs.run_state(job.run) == "stopped"
    with pytest.raises(InputError, match="not empty"):
        start()
    again = start(resume=True, mesh=False)
    until(lambda: again.ended)
    assert again.state == "done" and json.loads((tmp_path / "run" / "started").read_text())["resume"]


def test_the_same_folder_twice(start):
    start()
    with pytest.raises(InputError, match="being trained already"):
        start()


def test_what_fails_is_said_and_what_was_done_before_it_stays(start):
    job = start(mesh=True)
    until(lambda: job.ended)
    assert job.state == "failed" and job.line == "the mesh is crumbs" and "train" in job.results


def test_a_trainer_that_dies(start):
    job, next_one = start("crash", out="a"), start(out="b", mesh=False)
    until(lambda: job.ended)
    assert job.state == "failed" and "status 3" in job.line and job.log.exists()
    until(lambda: next_one.state == "done")


def test_a_trainer_that_is_newer(start, monkeypatch):
    monkeypatch.setenv("FAKE", "newer")
    job = start()
    until(lambda: job.ended)
    assert job.state == "failed" and "9.9, is newer than this add-on" in job.line


def test_a_line_that_is_no_event(start):
    job = start("noise", mesh=False)
    until(lambda: job.ended)
    assert job.state == "done" and job.warnings == [
        "this is no JSON", "not an event: 5", "not an event: {'event': 'progress'}",
    ]  # fmt: skip


def test_a_python_that_is_not_there(start, tmp_path):
    job = jobs.ask(tmp_path / "nothing", tmp_path / "log.txt")
    assert job.state == "failed" and "cannot be started" in job.line and "preferences" in job.line


def test_a_python_without_the_trainer(tmp_path):
    import sys

    job = jobs.ask(sys._base_executable, tmp_path / "log.txt")
    until(lambda: job.ended)
    assert job.state == "failed" and "log" in job.line


def test_cameras_are_found_then_checked(python, tmp_path):
    capture = tmp_path / "bare photos"
    capture.mkdir()
    checked = jobs.check(python, capture, tmp_path / "found", tmp_path / "check.txt")
    until(lambda: checked.ended)
    assert checked.state == "failed" and checked.no_cameras
    found = jobs.poses(python, capture, tmp_path / "found", tmp_path / "poses.txt")
    until(lambda: found.ended)
    assert found.state == "done" and found.progress["stage"] == "matching" and not found.curve
    assert found.results["poses"]["placed"] == 3 and found.results["check"]["lines"][0] == "Views: 3"


def test_asking_and_checking_run_beside_a_training(start, python, tmp_path):
    training = start()
    asked = jobs.ask(python, tmp_path / "log.txt")
    checked = jobs.check(python, tmp_path, tmp_path / "found", tmp_path / "check.txt")
    until(lambda: asked.ended and checked.ended)
    assert asked.state == "done" and asked.ready["refgs"] == "9.9"
    assert checked.results["check"]["lines"] == ["Views: 3", "Warning: they are dark"]
    assert training.state != "waiting"
