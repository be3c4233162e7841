import logging

import numpy as np
import pytest

from benchmarks.distances import around, gradient, look_at, mask, sphere, torus
from refgs.errors import InputError
from refgs.geometry.hull import visual_hull_points

VIEWS = around(32, 128)
DISCS = [mask(view, sphere) for view in VIEWS]
VOXEL = 2.2 / 48


def degrees(a, b):
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))


def test_points_lie_evenly_on_the_hull_of_a_sphere():
    positions, normals, spacing = visual_hull_points(DISCS, VIEWS, (0.1, 0, -0.1), 1.5, 2000, resolution=48)
    assert positions.shape == normals.shape == (2000, 3) and spacing.shape == (2000,)
    assert positions.dtype == normals.dtype == spacing.dtype == np.float32
    distance = sphere(positions)
    assert np.abs(distance).max() < VOXEL
    assert abs(distance.mean()) < 0.2 * VOXEL
    angle = degrees(normals, gradient(sphere, positions))
    assert angle.mean() < 2.5 and angle.max() < 12
    # 2000 points on an even hexagonal pattern would be this far apart; random ones' nearest three vary by a third.
    even = np.sqrt(4 * np.pi / 2000 * 2 / np.sqrt(3))
    assert 0.8 * even < spacing.mean() < 1.05 * even
    assert spacing.std() < 0.2 * spacing.mean()


def test_some_points_lie_inside():
    """As many in every part of the volume, their normals those of the surface that is near."""
    positions, normals, _ = visual_hull_points(DISCS, VIEWS, (0.1, 0, -0.1), 1.5, 4000, resolution=48, on_hull=1000)
    assert positions.shape == normals.shape == (4000, 3)
    assert np.abs(sphere(positions[:1000])).max() < VOXEL
    radius = np.linalg.norm(positions[1000:], axis=1)  # of a ball of radius 1 about the origin
    assert radius.max() < 1 + 2 * VOXEL and abs((radius**3).mean() - 0.5) < 0.05
    deep = radius > 0.3
    assert degrees(normals[1000:][deep], positions[1000:][deep] / radius[deep, None]).mean() < 10


def test_a_hole_through_the_object_stays_open():
    positions, normals, _ = visual_hull_points(
        [mask(view, torus) for view in VIEWS], VIEWS, (0, 0, 0), 1.5, 2000, resolution=64
    )
    assert np.abs(torus(positions)).max() < 0.1
    assert np.hypot(positions[:, 0], positions[:, 1]).min() > 0.4
    assert degrees(normals, gradient(torus, positions)).mean() < 5


def test_integer_masks_and_other_image_sizes():
    alphas = [np.round(255 * disc).astype(np.uint8) for disc in DISCS]
    alphas[3] = alphas[3][::2, ::2]
    positions, _, _ = visual_hull_points(alphas, VIEWS, (0, 0, 0), 1.5, 500, resolution=48)
    assert np.abs(sphere(positions)).max() < VOXEL


@pytest.mark.parametrize("damage", [np.zeros_like, lambda m: m * (np.arange(128) < 64), lambda m: np.roll(m, 40, 1)])
def test_one_bad_mask_does_not_destroy_the_object(damage, caplog):
    alphas = [*DISCS]
    alphas[7] = damage(alphas[7])
    with caplog.at_level(logging.WARNING):
        positions, _, _ = visual_hull_points(alphas, VIEWS, (0, 0, 0), 1.5, 500, resolution=48)
    assert np.abs(sphere(positions)).max() < VOXEL
    assert "left out" in caplog.text


def test_close_ups_do_not_carve_what_they_do_not_see():
    near = [look_at(1.6 * view.position / 4.5, 128, f"near{i}") for i, view in enumerate(VIEWS[:8])]
    alphas = [np.ones((128, 128), np.float32)] * 8
    positions, _, _ = visual_hull_points(DISCS + alphas, VIEWS + near, (0, 0, 0), 1.5, 500, resolution=48)
    assert np.abs(sphere(positions)).max() < VOXEL


def test_the_same_seed_gives_the_same_points():
    a, b = (visual_hull_points(DISCS, VIEWS, (0, 0, 0), 1.5, 300, resolution=32, seed=4)[0] for _ in range(2))
    assert np.array_equal(a, b)


def test_masks_without_a_common_object():
    blank = [np.zeros((128, 128), np.uint8)] * len(VIEWS)
    with pytest.raises(InputError, match="0 of 32 masks"):
        visual_hull_points(blank, VIEWS, (0, 0, 0), 1.5, 100, resolution=32)
    corner = np.zeros((128, 128), np.float32)
    corner[5:10, 5:10] = 1
    with pytest.raises(InputError, match="no common object"):
        visual_hull_points([corner] * len(VIEWS), VIEWS, (0, 0, 0), 1.5, 100, resolution=32)
