"""Test the refinement of poses in a training, on captures whose poses are exact or disturbed."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.poses import disturbed
from refgs.capture import read_capture
from refgs.capture.matches import Matches
from refgs.run import open_run
from refgs.settings import load_settings
from refgs.train.keep import asset
from refgs.train.learn import poses
from refgs.train.learn.poses import Poses
from tests.makers.training import check_equal, do, trained, trainer

ON = "cameras.poses=on"


@pytest.fixture(scope="module")
def moved(ball_capture):
    return disturbed(read_capture(ball_capture, load_settings("quick", []).region))


def test_nothing_moves_before_poses_learn_nor_in_the_last_third(ball_capture, tmp_path):
    made = trainer(ball_capture, tmp_path / "run", ON, total=60)
    while made.state.iteration < 3:
        made.iterate()
    assert not made.state.part(Poses).values.any()
    while made.state.iteration < 40:
        made.iterate()
    before = made.state.part(Poses).values.clone()
    assert before.any()
    while made.state.iteration < 60:
        made.iterate()
    assert torch.equal(made.state.part(Poses).values, before)


def shared_points(state, count=40):
    """Make matches without noise: what exact cameras see of some points, for each view and the next."""
    points = np.random.default_rng(0).normal(size=(count, 3)) * 0.5 * state.capture.radius + state.capture.centre
    pixels = []
    for camera in state.part(Poses).given:
        seen = np.c_[points, np.ones(count)] @ camera.projection.T
        pixels.append(seen[:, :2] / seen[:, 2:])
    return [Matches(i, i + 1, pixels[i], pixels[i + 1]) for i in range(len(pixels) - 1)]


@pytest.mark.parametrize("exact", [True, False])
def test_poses_are_kept_only_if_features_fit_them_better(ball_capture, tmp_path, monkeypatch, exact):
    """Check refined poses that made exact cameras worse, and poses that made disturbed cameras exact."""
    state = trainer(ball_capture, tmp_path / "run", "cameras.poses=auto", total=60).state
    pairs, off = shared_points(state), torch.zeros(len(state.views), 6)
    off[::2, 0] = 0.05
    if not exact:
        state.part(Poses).put(state, off)
        state.part(Poses).given = [view.camera for view in state.views]
    state.part(Poses).put(state, off if exact else -off)

    def matched(views):
        """Refined cameras may have other neighbours, with nothing in common: the given ones must tell."""
        return pairs if [view.camera for view in views] == state.part(Poses).given else []

    monkeypatch.setattr(poses, "match_neighbours", matched)
    do(state, "judge the poses", 0.29)
    assert "poses" not in state.decided
    do(state, "judge the poses", 0.31)
    assert (state.part(Poses).values is None) == exact and ("are kept" in state.decided["poses"]) == exact
    own = [view.camera is given for view, given in zip(state.views, state.part(Poses).given, strict=True)]
    assert all(own) if exact else not any(own)


@pytest.mark.parametrize(("apart", "refined"), [(None, False), (0.1, False), (1.5, True)])
def test_poses_are_refined_if_features_contradict_the_cameras(ball_capture, tmp_path, monkeypatch, apart, refined):
    monkeypatch.setattr(poses, "pixels_apart", lambda matches, cameras: apart)
    state = trainer(ball_capture, tmp_path / "run", "cameras.poses=auto", total=60).state
    assert (state.part(Poses).values is not None) == refined == ("poses" in state.decided)


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
    made.state.part(Poses).put(made.state, common.expand(len(made.state.views), 6).clone())
    do(made.state, "remove the poses' common motion", 0.2, done=len(made.state.views) - 1)
    assert torch.equal(made.state.part(Poses).values[0], common)
    do(made.state, "remove the poses' common motion", 0.2, done=len(made.state.views))
    assert made.state.part(Poses).values[:, :3].abs().max() < 1e-6


def test_a_resumed_training_has_the_same_poses(moved, tmp_path):
    whole = trainer(moved, tmp_path / "whole", ON, total=60)
    whole.run()
    first = trainer(moved, tmp_path / "halves", ON, total=60)
    first.run(lambda: first.state.iteration >= 25)
    second = trainer(moved, tmp_path / "halves", ON, total=60)
    second.resume()
    second.run()
    check_equal(whole, second)
    one, other = (made.state.part(Poses).values for made in (whole, second))
    assert torch.equal(one, other) and one.any()


def test_sides_of_surfels_are_those_that_refined_cameras_see(ball_capture, tmp_path):
    state = trainer(ball_capture, tmp_path / "run", total=1).state
    moved = replace(state.photos[0].camera, world_to_camera=np.eye(4))
    state.photos[0] = state.photos[0]._replace(camera=moved)
    assert asset._cameras(state) == [photo.camera for photo in state.photos]
