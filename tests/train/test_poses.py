"""Test the refinement of poses in a training, on captures whose poses are exact or disturbed."""

import json

import numpy as np
import pytest
import torch

from benchmarks.poses import disturbed
from refgs.capture import read_capture
from refgs.run import open_run
from refgs.settings import load_settings
from refgs.train import poses
from tests.makers.training import check_equal, trained, trainer

ON = "cameras.poses=on"


@pytest.fixture(scope="module")
def moved(ball_capture):
    return disturbed(read_capture(ball_capture, load_settings("quick", []).region))


def test_nothing_moves_before_poses_learn_nor_in_the_last_third(ball_capture, tmp_path):
    made = trainer(ball_capture, tmp_path / "run", ON, total=60)
    while made.state.iteration < 3:
        made.iterate()
    assert not made.state.poses.any()
    while made.state.iteration < 40:
        made.iterate()
    before = made.state.poses.clone()
    assert before.any()
    while made.state.iteration < 60:
        made.iterate()
    assert torch.equal(made.state.poses, before)


@pytest.mark.parametrize(("turn", "kept"), [(0.0, False), (0.05, True)])
def test_poses_that_hardly_moved_are_put_back(ball_capture, tmp_path, turn, kept):
    """Check that all cameras are the capture's own again if refining moved the photos by less than `poses.EXACT` pixels."""
    made = trainer(ball_capture, tmp_path / "run", "cameras.poses=auto", total=60)
    state = made.state
    poses.restore(state, torch.tensor([turn, 0, 0, 0, 0, 0]).repeat(len(state.views), 1))
    poses.leave_out_exact(state, 0.29)
    assert "poses" not in state.decided
    poses.leave_out_exact(state, 0.31)
    assert (state.poses is not None) == kept and ("exact" in state.decided["poses"]) != kept
    own = [view.camera is given for view, given in zip(state.views, state.given, strict=True)]
    assert not any(own) if kept else all(own)


def test_refined_poses_are_written(ball_capture, moved, tmp_path):
    """Check that cameras.json has the refined cameras of training views, and the given ones of held-out views."""
    made = trained(moved, tmp_path / "run", ON, total=90)
    run = open_run(tmp_path / "run")
    assert run.refined
    used = {view.camera.name: view.camera for view in made.state.views}
    given = {view.camera.name: view.camera for view in moved.test_views}
    for camera, split in zip(run.cameras, run.splits, strict=True):
        expected = (used if split == "train" else given)[camera.name]
        np.testing.assert_allclose(camera.world_to_camera, expected.world_to_camera, atol=1e-9)
    frames = json.loads((tmp_path / "run" / "cameras.json").read_text(encoding="utf-8"))["frames"]
    assert all(frame.get("refined", False) == (frame["split"] == "train") for frame in frames)


def test_a_motion_that_all_views_share_is_removed(moved, tmp_path):
    made = trainer(moved, tmp_path / "run", ON, total=60)
    common = torch.tensor([0.01, 0.02, 0.0, 0.1, 0.0, 0.2])
    made.state.poses = common.expand(len(made.state.views), 6).clone()
    assert poses._without_common(made.state)[:, :3].abs().max() < 1e-6


def test_a_resumed_training_has_the_same_poses(moved, tmp_path):
    whole = trainer(moved, tmp_path / "whole", ON, total=60)
    whole.run()
    first = trainer(moved, tmp_path / "halves", ON, total=60)
    first.run(lambda: first.state.iteration >= 25)
    second = trainer(moved, tmp_path / "halves", ON, total=60)
    second.resume()
    second.run()
    check_equal(whole, second)
    assert torch.equal(whole.state.poses, second.state.poses) and whole.state.poses.any()
