import logging

import numpy as np
import pytest

from refgs.errors import InputError
from refgs.geometry.hull import _carve, visual_hull_points
from refgs.kernels.load import supported
from tests.makers.distances import around, gradient, look_at, mask, sphere, torus

VIEWS = around(32, 128)
DISCS = [mask(view, sphere) for view in VIEWS]
VOXEL = 2.2 / 48


def hull(masks, cameras=VIEWS, count=500, resolution=48):
    return visual_hull_points(masks, cameras, (0, 0, 0), 1.5, count, resolution=resolution)


def degrees(a, b):
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))


def expected(masks, cameras, low, high, resolution):
    """Compute with numpy in float64 what `_carve` computes: the smallest mask values of each voxel.

    Each voxel's centre is projected into all views, where the masks are interpolated. Return for each voxel: the smallest mask value in any
    view, the second smallest, its mask values in all views, and the distance in pixels to the nearest picture border in any view.
    """
    grid = np.stack(np.meshgrid(*((np.arange(resolution) + 0.5) / resolution,) * 3, indexing="ij"), axis=-1)
    points, values, border = low + grid * (high - low), [], np.full(3 * (resolution,), np.inf)
    seen = np.zeros(border.shape, int)
    for alpha, camera in zip(masks, cameras, strict=True):
        alpha, (height, width) = alpha / 255.0, alpha.shape
        camera = camera.resized(width, height)
        local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        x = camera.fx * local[..., 0] / local[..., 2] + camera.cx
        y = camera.fy * local[..., 1] / local[..., 2] + camera.cy
        inside = (local[..., 2] > 0) & (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
        column, row = np.clip(x - 0.5, 0, width - 1), np.clip(y - 0.5, 0, height - 1)
        left, top = column.astype(int), row.astype(int)
        right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
        u, v = column - left, row - top
        found = (1 - v) * ((1 - u) * alpha[top, left] + u * alpha[top, right])
        found += v * ((1 - u) * alpha[below, left] + u * alpha[below, right])
        whole = max(alpha[0].max(), alpha[-1].max(), alpha[:, 0].max(), alpha[:, -1].max()) < 0.5
        values.append(np.where(inside, found, 0.0 if whole else 1.0))
        seen += inside | whole
        ahead = np.minimum.reduce([np.abs(edge) for edge in (x, width - x, y, height - y)])
        border = np.where(np.abs(local[..., 2]) < 0.01, 0, np.minimum(border, ahead))
    least, second = np.sort(values, axis=0)[:2]
    unseen = (seen < max(2, len(masks) // 8)) & (second > 0.01)
    return np.where(unseen, 0, least), np.where(unseen, 0, second), np.stack(values), border


@pytest.mark.parametrize("isa", supported())
def test_carving_matches_float64(isa, monkeypatch):
    """Check `_carve`, which finds each voxel's two smallest mask values among all views: they match float64 to 1e-4.

    Masks are noise of several sizes. Some cameras are inside the volume and some see only a part of it. The number of voxels is no multiple
    of the SIMD width.
    """
    monkeypatch.setenv("REFGS_ISA", isa)
    rng = np.random.default_rng(0)
    cameras = [look_at(view.position * (0.2 if i % 5 == 0 else 0.7), 64, view.name) for i, view in enumerate(VIEWS)]
    masks = [np.rint(255 * rng.uniform(0, 1, (40 + 3 * i, 50)) ** 0.1).astype(np.uint8) for i in range(len(cameras))]
    for alpha in masks[3::10]:
        alpha[[0, -1]], alpha[:, [0, -1]], alpha[10:20, 5:30] = 0, 0, 0
    masks[4] = masks[4][:, :1]
    low, high = np.array([-1.0, -0.8, -1.1]), np.array([0.9, 1.0, 1.2])
    least, second, carver = _carve(masks, cameras, low, high, 37)
    exact, next_to, values, border = expected(masks, cameras, low, high, 37)
    sure = border > 1e-3
    alive = sure & (next_to > 0.01)
    assert sure.mean() > 0.9 and 0.1 < alive.mean() < 0.9
    assert np.abs(least - exact)[alive].max() < 1e-4 and np.abs(second - next_to)[alive].max() < 1e-4
    assert (second[sure & (next_to <= 0.009)] <= 0.01).all()
    chosen = np.take_along_axis(values, carver[None], axis=0)[0]
    assert np.abs(chosen - exact)[alive & (exact > 0)].max() < 1e-4


def test_points_lie_evenly_on_the_hull_of_a_sphere():
    positions, normals, spacing, _ = visual_hull_points(DISCS, VIEWS, (0.1, 0, -0.1), 1.5, 2000, resolution=48)
    assert positions.shape == normals.shape == (2000, 3) and spacing.shape == (2000,)
    assert positions.dtype == normals.dtype == spacing.dtype == np.float32
    distance = sphere(positions)
    assert np.abs(distance).max() < VOXEL and abs(distance.mean()) < 0.2 * VOXEL
    angle = degrees(normals, gradient(sphere, positions))
    assert angle.mean() < 2.5 and angle.max() < 12
    # `even` is the spacing of 2000 points in a hexagonal pattern. The spacing of random points would vary by a third.
    even = np.sqrt(4 * np.pi / 2000 * 2 / np.sqrt(3))
    assert 0.8 * even < spacing.mean() < 1.05 * even
    assert spacing.std() < 0.2 * spacing.mean()


def test_some_points_lie_inside():
    """Check points placed inside the hull: they fill it evenly, and take the normal of the nearest point on its surface."""
    positions, normals, *_ = visual_hull_points(DISCS, VIEWS, (0.1, 0, -0.1), 1.5, 4000, resolution=48, on_hull=1000)
    assert positions.shape == normals.shape == (4000, 3)
    assert np.abs(sphere(positions[:1000])).max() < VOXEL
    radius = np.linalg.norm(positions[1000:], axis=1)  # the hull is a ball of radius 1 about the origin
    assert radius.max() < 1 + 2 * VOXEL and abs((radius**3).mean() - 0.5) < 0.05
    deep = radius > 0.3
    assert degrees(normals[1000:][deep], positions[1000:][deep] / radius[deep, None]).mean() < 10


def test_a_hole_through_the_object_stays_open():
    positions, normals, *_ = hull([mask(view, torus) for view in VIEWS], count=2000, resolution=64)
    assert np.abs(torus(positions)).max() < 0.1
    assert np.hypot(positions[:, 0], positions[:, 1]).min() > 0.4
    assert degrees(normals, gradient(torus, positions)).mean() < 5


def test_the_mesh_of_the_hull_faces_outward():
    surface = hull(DISCS).surface
    corners = surface.vertices[surface.faces]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.abs(sphere(surface.vertices)).max() < VOXEL
    assert ((facing * corners.mean(axis=1)).sum(axis=1) > 0).all()
    assert degrees(surface.normals, gradient(sphere, surface.vertices)).mean() < 2.5


def test_integer_masks_and_other_image_sizes():
    alphas = [np.round(255 * disc).astype(np.uint8) for disc in DISCS]
    alphas[3] = alphas[3][::2, ::2]
    assert np.abs(sphere(hull(alphas)[0])).max() < VOXEL


@pytest.mark.parametrize("damage", [np.zeros_like, lambda m: m * (np.arange(128) < 64), lambda m: np.roll(m, 40, 1)])
def test_one_bad_mask_does_not_destroy_the_object(damage, caplog):
    alphas = [*DISCS]
    alphas[7] = damage(alphas[7])
    with caplog.at_level(logging.WARNING):
        positions, *_ = hull(alphas)
    assert np.abs(sphere(positions)).max() < VOXEL and "left out" in caplog.text


def test_close_ups_do_not_carve_what_they_do_not_see():
    near = [look_at(1.6 * view.position / 4.5, 128, f"near{i}") for i, view in enumerate(VIEWS[:8])]
    alphas = [np.ones((128, 128), np.float32)] * 8
    assert np.abs(sphere(hull(DISCS + alphas, VIEWS + near)[0])).max() < VOXEL


def test_the_same_seed_gives_the_same_points():
    a, b = (visual_hull_points(DISCS, VIEWS, (0, 0, 0), 1.5, 300, resolution=32, seed=4)[0] for _ in range(2))
    assert np.array_equal(a, b)


def test_masks_without_a_common_object():
    blank = [np.zeros((128, 128), np.uint8)] * len(VIEWS)
    with pytest.raises(InputError, match="0 of 32 masks"):
        hull(blank, resolution=32)
    corner = np.zeros((128, 128), np.float32)
    corner[5:10, 5:10] = 1
    with pytest.raises(InputError, match="no common object"):
        hull([corner] * len(VIEWS), resolution=32)
