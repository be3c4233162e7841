"""Carve the visual hull, the largest shape that fits into all masks. Spread points on it and inside it."""

import ctypes
import logging
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs
from skimage.measure import marching_cubes

from refgs.camera import Camera
from refgs.errors import InputError
from refgs.formats.mesh import SmoothMesh
from refgs.kernels.layout import Work, struct
from refgs.kernels.load import kernels, parallel

# Part of the object that a single view may remove against all the others: above it, the view's mask is bad. True masks of a sphere
# and a torus remove at most 0.04 among 8 views, 0.015 among 12, 0.005 among 40.
_LONE_CARVER = 0.15
_FEWEST_VIEWS_TO_JUDGE = 8
_HALF = 128  # of 255: a mask shows the object from there

Carve = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class HullPoints(NamedTuple):
    """Hold points on a visual hull and inside it, in world units.

    - `positions` (N, 3)
    - `normals` (N, 3): outward unit normals. A point inside has the normal of the nearest point on the hull.
    - `spacing` (N,): the mean distance to the three nearest other points
    - `surface`: the hull's mesh

    The arrays are float32.
    """

    positions: np.ndarray
    normals: np.ndarray
    spacing: np.ndarray
    surface: SmoothMesh


def visual_hull_points(
    alphas: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    centre: np.ndarray,
    radius: float,
    count: int,
    resolution: int = 96,
    seed: int = 0,
    on_hull: int | None = None,
    carve: Carve | None = None,
) -> HullPoints:
    """Spread `count` points on the visual hull of an object: the largest shape that fits into all masks.

    The first `on_hull` points (None: all) lie evenly on the hull. The others are random points inside.

    `alphas` are the masks (H, W), one for each camera, floats in 0..1 or uint8. The hull is carved twice, on a grid of `resolution`³
    voxels: first in the cube of half-side `radius` about `centre`, then in the bounding box of the result. A view is left out, with a
    warning, if its mask is empty, or if it cuts away much that lies inside all other masks. `carve` may remove more of the hull. It is
    called with the voxels' alphas (X, Y, Z), the corner of the first voxel (3,) and the size of a voxel (3,). It returns which fraction of
    each voxel is left, (X, Y, Z). Raises InputError if no hull is left.
    """
    masks, views = [], []
    for alpha, camera in zip(alphas, cameras, strict=True):
        mask = _as_bytes(alpha)
        if mask.max() >= _HALF:
            masks.append(mask)
            views.append(camera)
    if len(views) < len(alphas):
        logging.getLogger(__name__).warning("%d masks are empty and were left out", len(alphas) - len(views))
    if len(views) < 2:
        raise InputError(
            f"only {len(views)} of {len(alphas)} masks show an object: check the images' alpha or the masks folder"
        )

    centre = np.asarray(centre, np.float64)
    low, high = centre - radius, centre + radius
    smallest, second, carver = _carve(masks, views, low, high, resolution)
    if len(views) >= _FEWEST_VIEWS_TO_JUDGE:
        solid = second > 0.5
        alone = np.bincount(carver[solid & (smallest < 0.5)], minlength=len(views)) / max(solid.sum(), 1)
        bad = np.flatnonzero(alone > _LONE_CARVER)
        if len(bad):
            names = ", ".join(views[i].name for i in bad)
            logging.getLogger(__name__).warning("masks that contradict the other views were left out: %s", names)
            masks = [mask for i, mask in enumerate(masks) if i not in bad]
            views = [view for i, view in enumerate(views) if i not in bad]
            smallest, _, _ = _carve(masks, views, low, high, resolution)

    # Bounds have a low threshold: a coarse voxel may only graze a thin part.
    found = np.argwhere(smallest > 0.05)
    if len(found) == 0:
        raise InputError(
            "the masks have no common object (their visual hull is empty): check that masks and poses belong together"
        )
    voxel = (high - low) / resolution
    low, high = low + (found.min(0) - 1) * voxel, low + (found.max(0) + 2) * voxel
    smallest, _, _ = _carve(masks, views, low, high, resolution)
    voxel = (high - low) / resolution
    if carve is not None:
        smallest *= carve(smallest, low, voxel)

    # Pad with empty voxels, which close the hull where the cube cuts it.
    field = gaussian_filter(np.pad(smallest, 3), 0.8)
    if field.max() <= 0.5:
        raise InputError(
            f"the visual hull is thinner than {float(voxel.max()):.3g} world units: check the poses and the masks"
        )
    vertices, faces, _, _ = marching_cubes(field, 0.5)
    rng = np.random.default_rng(seed)
    on_hull = count if on_hull is None else on_hull
    points = _choose_evenly(_sample_triangles(vertices * voxel, faces, 10 * on_hull, rng), on_hull)
    # Compute normals from a wider filter: masks' edges are about a voxel wide, so the gradient of one voxel is noise.
    wide = gaussian_filter(field, 1.5)
    slope = [-np.gradient(wide, voxel[a], axis=a) for a in range(3)]
    normals, outward = (_normals(slope, at) for at in (points / voxel, vertices))
    solid = rng.choice(np.argwhere(field > 0.5), count - on_hull)
    within = (solid + rng.uniform(-0.5, 0.5, solid.shape)) * voxel
    normals = np.concatenate([normals, normals[cKDTree(points).query(within)[1]]])
    points = np.concatenate([points, within])
    neighbours = [2, 3, 4][: count - 1]
    spacing = cKDTree(points).query(points, k=neighbours)[0].mean(1) if neighbours else np.full(1, radius)
    first = low + voxel * (0.5 - 3)
    outside = np.ascontiguousarray(faces[:, ::-1])  # seen from outside, corners go round anticlockwise
    surface = SmoothMesh(first + voxel * vertices, outside, outward)
    placed, normals, spacing = (x.astype(np.float32) for x in (first + points, normals, spacing))
    return HullPoints(placed, normals, spacing, surface)


def _normals(slope: list[np.ndarray], at: np.ndarray) -> np.ndarray:
    """Interpolate the slope, three grids, at positions (N, 3) in voxels, and return unit vectors (N, 3)."""
    normals = np.stack([map_coordinates(part, at.T, order=1) for part in slope], axis=1)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)


def _as_bytes(alpha: np.ndarray) -> np.ndarray:
    """Convert a mask of floats in 0..1 to uint8; return uint8 masks without a copy."""
    alpha = np.asarray(alpha)
    return alpha if alpha.dtype == np.uint8 else np.rint(255 * alpha).astype(np.uint8)


_Silhouette = struct("Silhouette", "carve.cpp")
_Work = struct("Carve", "carve.cpp")


def _silhouette(mask: np.ndarray, camera: Camera, low: np.ndarray, voxel: np.ndarray) -> Work:
    height, width = mask.shape
    matrix = camera.resized(width, height).projection
    # A mask clear of the picture's border shows the whole object: space outside the picture is empty. Otherwise it is unknown.
    whole = max(mask[0].max(), mask[-1].max(), mask[:, 0].max(), mask[:, -1].max()) < _HALF
    first, step = matrix[:, :3] @ (low + 0.5 * voxel) + matrix[:, 3], matrix[:, :3] * voxel
    size = {"width": width, "height": height, "whole": int(whole)}
    return _Silhouette(first=tuple(first), step=tuple(step.ravel()), mask=mask.ctypes.data, **size)


def _carve(masks, cameras, low, high, resolution):
    """Look up the alpha of each voxel in all masks (H, W) uint8. The voxels fill the box from `low` to `high`.

    Returns three arrays (resolution, resolution, resolution). For each voxel they have the smallest alpha in any view, the second smallest,
    and the index of the view that has the smallest. Voxels seen by fewer than two views, or by fewer than an eighth of all views, have the
    alpha 0.
    """
    masks, voxel = [np.ascontiguousarray(mask) for mask in masks], (high - low) / resolution
    views = [_silhouette(mask, camera, low, voxel) for mask, camera in zip(masks, cameras, strict=True)]
    least, second = (np.empty(3 * (resolution,), np.float32) for _ in range(2))
    carver, seen = (np.empty(3 * (resolution,), np.int32) for _ in range(2))
    silhouettes = (_Silhouette * len(views))(*views)
    work = _Work(resolution=resolution, views=len(views), silhouettes=ctypes.addressof(silhouettes))
    for name, values in (("least", least), ("second", second), ("carver", carver), ("seen", seen)):
        setattr(work, name, values.ctypes.data)
    parallel(kernels().refgs_carve, work)
    unseen = (seen < max(2, len(cameras) // 8)) & (second > 0.01)
    least[unseen] = second[unseen] = 0
    return least, second, carver


def _sample_triangles(vertices: np.ndarray, faces: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw `count` random points on triangles, with uniform density on the surface. Returns (count, 3)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    # Stratified, one stratum a point: the gaps are smaller than with independent draws.
    where = (np.arange(count) + rng.random(count)) / count
    chosen = np.searchsorted(np.cumsum(area) / area.sum(), where).clip(max=len(faces) - 1)
    u, v = rng.random((2, count, 1))
    root = np.sqrt(u)
    return a[chosen] * (1 - root) + b[chosen] * (root * (1 - v)) + c[chosen] * (root * v)


def _choose_evenly(dense: np.ndarray, count: int) -> np.ndarray:
    """Choose `count` evenly spaced points (count, 3) from `dense` by Lloyd iterations."""
    # Each iteration groups the points by the nearest chosen one, and then chooses the point nearest to its group's mean.
    chosen = dense[:: len(dense) // count][:count]
    for _ in range(5):
        cell = cKDTree(chosen).query(dense)[1]
        size = np.bincount(cell, minlength=count)
        mean = np.stack([np.bincount(cell, dense[:, a], count) for a in range(3)], axis=1)
        mean = np.where(size[:, None] > 0, mean / np.maximum(size, 1)[:, None], chosen)
        distance = ((dense - mean[cell]) ** 2).sum(1)
        order = np.lexsort((distance, cell))
        cells, starts = np.unique(cell[order], return_index=True)
        chosen = chosen.copy()
        chosen[cells] = dense[order[starts]]
    return chosen
