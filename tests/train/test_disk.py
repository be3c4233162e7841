"""Test disks that fill up or are removed during a training or an export."""

import pytest

from refgs import train_job
from refgs.errors import InputError
from refgs.export.export_job import export
from tests.makers.disk import fill

SMALL = ["surfels.start=500", "surfels.budget=500", "surfels.hull=48", "environment.resolution=16"]


def train(capture, run, attend, *changes, resume=False):
    return train_job.train(capture, run, "quick", "cpu", None, [*changes], resume, lambda event, facts: None, attend)


def test_a_disk_that_is_taken_out(ball_capture, tmp_path):
    disk, away = tmp_path / "disk", tmp_path / "away"
    disk.mkdir()

    def take_out(trainer):
        if trainer.iteration == 50:
            disk.rename(away)
        return False

    words = [*SMALL, "train.iterations=80", "train.checkpoint_every=20"]
    with pytest.raises(
        InputError, match=r"run is no longer there: put its disk back, then resume with --resume"
    ) as said:
        train(ball_capture, disk / "run", take_out, *words)
    assert "\n" not in str(said.value)
    away.rename(disk)
    trainer, _ = train(ball_capture, disk / "run", lambda trainer: trainer.iteration == 41, resume=True)
    assert trainer.iteration == 41
    trainer, _ = train(ball_capture, disk / "run", lambda trainer: False, resume=True)
    assert trainer.ended and (disk / "run" / "splats.ply").exists()


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


def test_a_mesh_that_cannot_be_written(ball_capture, small_disk):
    """Check that an export that fails on a full disk leaves the old mesh and textures unchanged."""
    run = small_disk / "run"
    words = ["train.iterations=60", "mesh.resolution=32", "mesh.triangles=500"]
    train(ball_capture, run, lambda trainer: False, *SMALL, *words)
    given = [run, None, 64, None, None, True, lambda event, facts: None]
    export(*given)
    before = {file: file.read_bytes() for file in [run / "mesh.glb", *(run / "textures").iterdir()]}
    with pytest.raises(InputError, match=r"name that ends so"):
        export(run, run / "mesh.stl", *given[2:])
    fill(small_disk / "filler")
    with pytest.raises(InputError, match=r"No space left on device\): mend that, then export again"):
        export(*given)
    assert before == {file: file.read_bytes() for file in [run / "mesh.glb", *(run / "textures").iterdir()]}
