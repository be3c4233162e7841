"""Test disks that fill up or are removed during a training or an export."""

import subprocess
import sys
from pathlib import Path

import pytest

from refgs import capture, commands, train_job
from refgs.asked import Asked
from refgs.capture import cached, read_capture, remove_cached
from refgs.errors import InputError
from refgs.export.export_job import export
from refgs.report.page import write_report
from tests.makers.ball import write_run
from tests.makers.disk import fill

SMALL = ["surfels.start=500", "surfels.budget=500", "surfels.hull=48", "environment.resolution=16"]


def train(capture, run, attend, *changes, resume=False):
    asked = Asked(capture, run, "quick", "cpu", changes=changes, resume=resume)
    return train_job.train(asked, lambda event, facts: None, attend)


def test_a_disk_that_is_taken_out(ball_capture, tmp_path):
    disk, away = tmp_path / "disk", tmp_path / "away"
    disk.mkdir()

    def take_out(trainer):
        if trainer.iteration == 25:
            disk.rename(away)
        return False

    words = [*SMALL, "train.iterations=40", "train.checkpoint_every=10"]
    with pytest.raises(
        InputError, match=r"run is no longer there: put its disk back, then resume with --resume"
    ) as said:
        train(ball_capture, disk / "run", take_out, *words)
    assert "\n" not in str(said.value)
    away.rename(disk)
    trainer, _ = train(ball_capture, disk / "run", lambda trainer: trainer.iteration == 21, resume=True)
    assert trainer.iteration == 21
    trainer, _ = train(ball_capture, disk / "run", lambda trainer: False, resume=True)
    assert trainer.ended and (disk / "run" / "splats.ply").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("end", ["done", "failed"])
def test_no_photo_is_mapped_when_photos_are_removed(ball_capture, tmp_path, monkeypatch, end):
    """Check that reduced photos are no longer in use when the training ends, or fails before it starts. Windows would keep them."""
    photos, mapped = tmp_path / "run" / "photos", []

    def remove(folder):
        mapped.append([line for line in Path("/proc/self/maps").read_text().splitlines() if str(photos) in line])
        remove_cached(folder)

    monkeypatch.setattr(cached, "LARGE", 0)
    monkeypatch.setattr(capture, "remove_cached", remove)
    words = [*SMALL, "train.iterations=20"]
    if end == "failed":
        monkeypatch.setattr("refgs.train.trainer.Measures", lambda state: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            train(ball_capture, tmp_path / "run", lambda state: False, *words)
    else:
        train(ball_capture, tmp_path / "run", lambda state: not photos.is_dir(), *words)
    assert mapped == [[]] and not photos.exists()


def test_a_disk_that_is_full(ball_capture, small_disk):
    """Check that a training on a full disk ends with a one-line error, and can be resumed once there is space.

    The disk is full from iteration 99, between two checkpoints, so another file cannot be written. test_checkpoint.py tests a checkpoint
    that cannot be written.
    """
    filler = small_disk / "filler"

    def later(trainer):
        if trainer.iteration == 99:
            fill(filler)
        return False

    with pytest.raises(InputError, match=r"cannot be written \(No space left on device\): mend that") as said:
        train(ball_capture, small_disk / "run", later, *SMALL, "train.iterations=120", "train.checkpoint_every=40")
    assert "\n" not in str(said.value)
    filler.unlink()
    trainer, _ = train(ball_capture, small_disk / "run", lambda trainer: False, resume=True)
    assert trainer.ended and (small_disk / "run" / "splats.ply").exists()


def test_a_read_only_disk(ball_capture, small_disk, tmp_path):
    """Check that nothing that writes into a run, or makes one, ends otherwise than in one line where the disk is read-only."""
    run = write_run(small_disk / "run", read_capture(ball_capture))
    before = files(run)
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    cameras = ball_capture / "transforms_test.json"
    jobs = [
        lambda: train(ball_capture, small_disk / "new", lambda state: False, *SMALL),
        lambda: export(run, None, 64, None, None, True, lambda event, facts: None),
        lambda: commands.evaluate(run, "test", None),
        lambda: write_report([run], run / "report.html"),
        lambda: commands.render(run, cameras, run / "rendered", ["color"], None, "exr"),
    ]
    for job in jobs:
        with pytest.raises(InputError, match="Read-only file system") as said:
            job()
        assert "\n" not in str(said.value)
    assert files(run) == before


def files(run):
    """Read all files of a run folder: {path: content}."""
    return {file: file.read_bytes() for file in run.rglob("*") if file.is_file()}


def test_a_run_on_a_full_disk(ball_capture, small_disk):
    """Check that exports, evaluations, reports and renderings on a full disk fail with one line, and leave the run as it was."""
    run = small_disk / "run"
    words = ["train.iterations=20", "mesh.resolution=32", "mesh.triangles=500"]
    train(ball_capture, run, lambda trainer: False, *SMALL, *words)
    given = [run, None, 64, None, None, True, lambda event, facts: None]
    export(*given)
    before = files(run)
    with pytest.raises(InputError, match=r"name that ends so"):
        export(run, run / "mesh.stl", *given[2:])
    fill(small_disk / "filler")
    with pytest.raises(InputError, match=r"No space left on device\): mend that, then export again"):
        export(*given)
    cameras = ball_capture / "transforms_test.json"
    for again, job in {
        "evaluate again": lambda: commands.evaluate(run, "test", None),
        "write the report again": lambda: write_report([run], run / "report.html"),
        "render again": lambda: commands.render(run, cameras, run / "rendered", ["color"], None, "exr"),
    }.items():
        with pytest.raises(InputError, match=rf"No space left on device\): mend that, then {again}") as said:
            job()
        assert "\n" not in str(said.value)
    assert before == files(run)
