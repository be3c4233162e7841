"""Test that the 3D view shows a training's surfels while the training runs."""

import bpy
import pytest

from refgs_addon import jobs
from refgs_addon.nodes.splats_tree import NAME
from refgs_addon.trainer.scene import live_splats
from tests.makers.runs import random_columns, write_ply
from tests.makers.waiting import until


@pytest.fixture
def job(tmp_path):
    """Make the job of a training that has no preview yet."""
    return jobs.Job("pot", tmp_path, [], tmp_path / "log.txt", run=tmp_path / "run", state="running")


def preview(job, tmp_path, iteration, count):
    write_ply(tmp_path / f"{iteration}.ply", random_columns(count))
    job.preview = {"iteration": iteration, "splats": str(tmp_path / f"{iteration}.ply")}


def clouds():
    """Return the point clouds in the open Blender file."""
    return [item for item in bpy.data.objects if item.type == "POINTCLOUD"]


def shown():
    """Update the live preview, and return the number of points that the 3D view shows."""
    live_splats.update()
    return len(clouds()[0].data.points)


def test_the_surfels_come_change_and_go(job, scene, tmp_path):
    live_splats.watch(job, scene)
    live_splats.update()
    (item,) = clouds()
    assert live_splats.is_watched(job) and len(item.data.points) == 0 and item.modifiers[NAME].node_group
    preview(job, tmp_path, 10, 30)
    until(lambda: shown() == 30)
    preview(job, tmp_path, 20, 50)
    until(lambda: shown() == 50)
    assert clouds() == [item] and len(bpy.data.pointclouds) == 1 and len(item.data.materials) == 1
    preview(job, tmp_path, 30, 30)
    (tmp_path / "30.ply").write_bytes(b"half")  # an unreadable preview is skipped
    live_splats.update()
    preview(job, tmp_path, 40, 20)
    until(lambda: shown() == 20)
    job.state = "done"
    live_splats.update()
    assert not clouds() and not bpy.data.pointclouds and not live_splats.is_watched(job)


def test_what_is_deleted_or_switched_off_stays_away(job, scene, tmp_path):
    preview(job, tmp_path, 10, 30)
    live_splats.watch(job, scene)
    until(lambda: shown() == 30)
    live_splats.watch(job, scene, False)
    assert not clouds() and not live_splats.is_watched(job)
    live_splats.watch(job, scene)
    bpy.data.objects.remove(clouds()[0])
    live_splats.update()
    assert not live_splats.is_watched(job)
    live_splats.watch(job, scene)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.name = "another file"
    live_splats.update()
    assert not live_splats.is_watched(job) and not clouds()
