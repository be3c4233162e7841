"""Test signed distances on a grid: their values, rays that enter the shape, and the mesh."""

import numpy as np
import pytest
import torch

from refgs.geometry.field import Field, sample
from tests.makers.distances import sphere, spread
from tests.makers.textured import grid


@pytest.fixture(scope="module")
def ball():
    shape = grid(sphere)
    return Field.of(shape.solid.astype(np.float32), shape.low, shape.voxel)


def world(ball, index):
    return ball.low + np.asarray(index) * ball.voxel


def test_distances_of_a_ball(ball):
    index = np.argwhere(np.abs(ball.values) < 3)
    true = sphere(world(ball, index)) / ball.voxel
    off = np.abs(ball.values[np.abs(ball.values) < 3] - true)
    assert off.mean() < 0.2
    assert off.max() < 0.7


def test_values_between_voxels_are_linear(ball):
    at = torch.rand(100, 3, generator=torch.Generator().manual_seed(0)) * 20
    values = torch.from_numpy(np.indices(ball.values.shape, np.float32))
    np.testing.assert_allclose(sample(values, at).numpy(), at.numpy(), atol=1e-4)


def test_rays_enter_and_leave_a_ball(ball):
    outward = torch.from_numpy(spread(200)).float()
    centre, radius = torch.from_numpy(-ball.low / ball.voxel).float(), 1 / ball.voxel
    origin, direction = centre + 3 * radius * outward, -outward
    near, far = ball.enter(origin, direction, 0.0)
    np.testing.assert_allclose(near.numpy(), 2 * radius, atol=0.7)
    np.testing.assert_allclose(far.numpy(), 4 * radius, atol=0.7)
    assert ball.enter(origin, outward, 0.0)[0].isnan().all()


def test_a_mesh_has_the_balls_normals(ball):
    mesh = ball.mesh()
    points = world(ball, mesh.vertices)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, atol=0.7 * ball.voxel)
    facing = (mesh.normals * points).sum(axis=1) / np.linalg.norm(points, axis=1)
    assert np.degrees(np.arccos(facing.clip(-1, 1))).mean() < 5
