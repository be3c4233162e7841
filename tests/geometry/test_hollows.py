"""Test that hollows are carved where photos show them, and nothing else is."""

import numpy as np
import pytest

from refgs.geometry.hollows import carve_hollows
from tests.makers.distances import around, box, sphere
from tests.makers.textured import bowl, grid, half_ball, photograph

VIEWS = around(48, 96)


def left(sdf, hull, views=VIEWS, **how) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points of a hull's voxels, how much of each is left, and its signed distance from the true shape."""
    shape = grid(hull)
    photos = [photograph(camera, sdf, **how) for camera in views]
    kept = carve_hollows(shape.solid.astype(np.float32), shape.low, shape.voxel, photos)
    points = shape.low + (np.argwhere(shape.solid) + 0.5) * shape.voxel
    return points, kept[shape.solid], sdf(points)


def test_a_speckled_bowl_is_opened():
    points, kept, distance = left(bowl, half_ball)
    hollow = (distance > 0.12) & (points[:, 2] < -0.05)
    assert np.mean(kept[hollow] < 0.5) > 0.7
    assert np.mean(kept[distance < -0.02] > 0.5) > 0.97


def test_a_bowl_without_texture_stays_closed():
    _, kept, _ = left(bowl, half_ball, contrast=0.01)
    assert np.mean(kept < 0.5) < 0.01


@pytest.mark.parametrize("sdf", [sphere, box])
@pytest.mark.parametrize("mirror", [False, True])
def test_what_has_no_hollow_stays_whole(sdf, mirror):
    """Check a ball and a block. What a ball mirrors seems to lie inside it, what a block's faces mirror, far behind them."""
    _, kept, _ = left(sdf, sdf, mirror=mirror)
    assert np.mean(kept < 0.5) < 0.01


def test_few_photos_carve_nothing():
    _, kept, _ = left(bowl, half_ball, views=VIEWS[::8])
    assert kept.min() > 0.99
