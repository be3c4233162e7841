"""Test that a camera that was moved finds back to where its picture was taken."""

import numpy as np
import pytest
import torch

from refgs.camera import Camera
from refgs.model.surfels import activate, initial_parameters
from refgs.render.align import fitted, pose_step, posed
from refgs.render.renderer import render
from refgs.settings import load_settings

CENTRE, RADIUS, SIDE = np.array([0.2, -0.1, 0.3]), 1.0, 96


@pytest.fixture(scope="module")
def points():
    """Return points (N, 3) on an ellipsoid about CENTRE, which has no symmetry that a rotation could hide in."""
    directions = np.random.default_rng(0).normal(size=(6000, 3))
    return CENTRE + directions / np.linalg.norm(directions, axis=1, keepdims=True) * [1.0, 0.8, 0.6]


@pytest.fixture(scope="module")
def picture(points):
    """Return a function that renders a camera's picture of opaque surfels at the points, whose colours are waves."""
    normals = (points - CENTRE) / [1.0, 0.64, 0.36]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colours = 0.5 + 0.4 * np.sin(points @ np.array([[9.0, 2, 4], [3, 8, -5], [-2, 5, 7]]))
    options = {"opacity": 0.95, "sh_degree": 0, "albedo": 0.5, "metallic": 0.5, "roughness": 0.3}
    surfels = activate(initial_parameters(points, normals, np.full(len(points), 0.03), colours, **options))
    settings = load_settings("quick", ["shading=sh"]).render

    def picture(camera):
        with torch.no_grad():
            return render(surfels, None, camera, torch.ones(3), settings, 0.01)

    return picture


@pytest.fixture(scope="module")
def camera():
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # looks along y
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, [0, 0, 4]
    return Camera("front", SIDE, SIDE, 130.0, 130.0, SIDE / 2, SIDE / 2, pose)


def shift(points, one, other) -> float:
    """Return by how many pixels, root mean square, the points differ between two cameras."""
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    ours, theirs = (homogeneous @ camera.projection.T for camera in (one, other))
    return float(np.sqrt(np.square(ours[:, :2] / ours[:, 2:] - theirs[:, :2] / theirs[:, 2:]).sum(axis=1).mean()))


@pytest.mark.parametrize("axis", range(6))
def test_a_step_undoes_a_small_motion(picture, points, camera, axis):
    """Check a step against a small motion of the scene, one of the six at a time: most of it goes in one step."""
    pose = torch.zeros(6)
    pose[axis] = 0.02
    moved = posed(camera, pose, CENTRE, RADIUS)
    step = pose_step(picture(moved), picture(camera).color, moved, CENTRE, RADIUS)
    assert shift(points, posed(moved, step, CENTRE, RADIUS), camera) < 0.5 * shift(points, moved, camera)


def test_a_camera_finds_back(picture, points, camera):
    moved = posed(camera, torch.tensor([0.02, -0.015, 0.02, 0.02, -0.02, 0.04]), CENTRE, RADIUS)
    found = fitted(picture, moved, picture(camera).color, CENTRE, RADIUS)
    assert shift(points, moved, camera) > 1
    assert shift(points, found, camera) < 0.02


def test_an_empty_picture_moves_nothing(picture, camera):
    away = posed(camera, torch.tensor([0.0, 0, 0, 50, 50, 50]), CENTRE, RADIUS)
    rendering = picture(away)
    assert not pose_step(rendering, torch.zeros_like(rendering.color), away, CENTRE, RADIUS).any()
