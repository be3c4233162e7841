"""Test that hollows are carved where photos show them, and nothing else is."""

import numpy as np
import pytest

from refgs.geometry import explain, field, fog, hollows
from refgs.geometry.hollows import carve_hollows
from tests.makers.distances import around, box, sphere
from tests.makers.textured import bowl, carve_coarsely, grid, half_ball, photograph

VIEWS = around(32, 96)


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    carve_coarsely(monkeypatch)


def carved(sdf, hull, views=VIEWS, **how) -> np.ndarray:
    """Return how much of each voxel of a shape's hull is left."""
    return carved_by([photograph(camera, sdf, **how) for camera in views], hull)


def carved_by(photos, hull) -> np.ndarray:
    shape = grid(hull)
    return carve_hollows(shape.solid.astype(np.float32), shape.low, shape.voxel, photos)


def left(sdf, hull, **how) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points of a hull's voxels, how much of each is left, and its signed distance from the true shape."""
    shape, kept = grid(hull), carved(sdf, hull, **how)
    points = shape.low + (np.argwhere(shape.solid) + 0.5) * shape.voxel
    return points, kept[shape.solid], sdf(points)


def test_a_speckled_bowl_is_opened():
    points, kept, distance = left(bowl, half_ball)
    hollow = (distance > 0.12) & (points[:, 2] < -0.05)
    assert np.mean(kept[hollow] < 0.5) > 0.9
    assert np.mean(kept[distance < -0.06] > 0.5) > 0.98


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
    assert carved(bowl, half_ball, views=VIEWS[::2]).min() == 1


def test_an_empty_hull_stays_empty():
    photos = [photograph(camera, sphere) for camera in VIEWS]
    nothing = np.zeros((8, 8, 8), np.float32)
    assert carve_hollows(nothing, np.full(3, -1.0), np.full(3, 0.25), photos).min() == 1


def test_the_same_seed_carves_the_same(monkeypatch):
    monkeypatch.setattr(field, "SIDE", 32)
    for module in (fog, explain):
        monkeypatch.setattr(module, "ITERATIONS", 20)
    photos = [photograph(camera, bowl) for camera in VIEWS]
    np.testing.assert_array_equal(carved_by(photos, half_ball), carved_by(photos, half_ball))


@pytest.mark.parametrize(
    ("errors", "carved_times"),
    [
        ([0.2, 0.17, 0.169, 0.168], 3),  # each fog opens a little more
        ([0.2, 0.17, 0.1699], 1),  # a second fog is not worth its seconds
        ([0.2, 0.17, 0.165, 0.17], 2),
        ([0.2, 0.19], 0),  # the first must explain photos much better
        ([0.04], 0),
    ],
)
def test_fogs_follow_while_photos_are_explained_better(monkeypatch, errors, carved_times):
    """Check how often a hull is carved if carved shapes have these errors. A shape is the number of times that it was carved."""

    class Shape(int):
        values = np.array([-1.0])

    class Explained:
        def __init__(self, shape, rays, seed):
            self.mean = errors[shape] if shape < len(errors) else 0.0  # no error is asked for beyond the last

    monkeypatch.setattr(hollows, "Explained", Explained)
    monkeypatch.setattr(hollows, "known", lambda hull, photos: None)
    monkeypatch.setattr(hollows, "open_hull", lambda shape, known, rays, seed: Shape(0))
    monkeypatch.setattr(hollows, "mix", lambda shape, fog, first, second: Shape(shape + 1))
    monkeypatch.setattr(hollows.Rays, "of", lambda photos, hull: None)
    assert hollows.choose(Shape(0), [], 0) == carved_times
