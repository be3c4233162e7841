"""A mesh from depth maps: truncated signed distance fusion (Curless and Levoy 1996, "A Volumetric Method for Building
Complex Models from Range Images"), then marching cubes."""

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.ndimage import binary_dilation
from skimage.measure import marching_cubes

from refgs.camera import Camera
from refgs.geometry.mesh import Mesh
from refgs.geometry.project import inside, project, sample

_TRUNCATION = 4.0  # voxels: 3 halves the bias at sharp corners, 5 averages more noise away
_BLOCK = 4  # voxels along the side of the blocks in which the band around the surface is kept
_CHUNK = 1 << 18  # voxels projected at a time, so that they stay in the cache
_EDGE_WEIGHT = 0.1  # of a pixel beside a jump in depth or alpha; at 1 a sphere comes out a tenth of a voxel too large
_LEAST_WEIGHT = 0.02  # a voxel with less was hardly seen: no surface is made beside it


def fuse(
    depths: Sequence[np.ndarray],
    alphas: Sequence[np.ndarray],
    cameras: Sequence[Camera],
    centre: np.ndarray,
    radius: float,
    resolution: int,
) -> Mesh:
    """The surface that depth maps agree on, inside the cube of half-side `radius` about `centre`.

    `depths` (H, W) are distances along the camera's axis in world units, already divided by alpha; `alphas` (H, W) in
    0..1. A pixel with alpha below a half is background: all that its ray passes is empty. So the silhouettes of a
    masked object carve, and a capture without masks, whose alpha is 1, is left alone. Pixels beside a jump in depth or
    alpha count for little, and say where the surface is but not that what lies before it is empty: there the ray may
    have missed a neighbour by half a pixel.

    Only voxels within two blocks of a pixel's depth are looked at, so time follows the surface and not the cube.
    The result has outward faces, is open where nothing was seen, and has no faces where there is no surface.
    60 views of 256² and their votes take 0.1 GB; the grid 0.15 GB at 256³ and 1 GB at 512³.
    """
    voxel = 2 * radius / resolution
    low = np.asarray(centre, np.float64) - radius
    views = [_View(d, a, c, voxel) for d, a, c in zip(depths, alphas, cameras, strict=True)]

    blocks = -(-resolution // _BLOCK)
    occupied = np.zeros((blocks,) * 3, bool)
    for view in views:
        cell = np.floor((view.points - low) / (voxel * _BLOCK)).astype(np.int32)
        cell = cell[((cell >= 0) & (cell < blocks)).all(1)]
        occupied[tuple(cell.T)] = True
    occupied = binary_dilation(occupied, np.ones((3, 3, 3)))
    offsets = np.stack(np.meshgrid(*[np.arange(_BLOCK)] * 3, indexing="ij"), axis=-1).reshape(1, -1, 3)
    index = (np.argwhere(occupied)[:, None] * _BLOCK + offsets).reshape(-1, 3).astype(np.int16)
    index = index[(index < resolution).all(1)]

    distance = np.ones((resolution,) * 3, np.float32)
    observed = np.zeros((resolution,) * 3, bool)
    for start in range(0, len(index), _CHUNK):
        part = index[start : start + _CHUNK]
        points = (part.astype(np.float32) + np.float32(0.5)) * np.float32(voxel) + low.astype(np.float32)
        total = np.zeros(len(part), np.float32)
        weight = np.zeros(len(part), np.float32)
        for view in views:
            view.vote(points, total, weight)
        where = tuple(part.T)
        observed[where] = weight > _LEAST_WEIGHT
        distance[where] = np.where(weight > _LEAST_WEIGHT, total / np.maximum(weight, 1e-20), 1)

    # Marching cubes visits a cell where its last corner is in the mask: all eight must have been observed.
    whole = observed.copy()
    for axis in range(3):
        whole[(slice(None),) * axis + (slice(1, None),)] &= whole[(slice(None),) * axis + (slice(-1),)].copy()
        whole[(slice(None),) * axis + (0,)] = False
    if not whole.any() or not distance.min() < 0 < distance.max():
        return Mesh.empty()
    try:
        vertices, faces, _, _ = marching_cubes(distance, 0.0, mask=whole)
    except RuntimeError:  # no surface in the mask
        return Mesh.empty()
    return Mesh(vertices.astype(np.float64) * voxel + low + 0.5 * voxel, faces)


class _View:
    """What one depth map says about voxels."""

    def __init__(self, depth: np.ndarray, alpha: np.ndarray, camera: Camera, voxel: float):
        height, width = depth.shape
        self.camera = camera.resized(width, height)
        self.truncation = _TRUNCATION * voxel
        solid = (np.asarray(alpha) >= 0.5) & np.isfinite(depth) & (depth > 0)
        depth = np.where(solid, depth, 0).astype(np.float32)
        box = np.ones((3, 3), np.uint8)
        nearest = -cv2.dilate(-np.where(solid, depth, np.inf).astype(np.float32), box)
        farthest = cv2.dilate(depth, box)
        background = cv2.dilate((~solid).astype(np.uint8), box) > 0
        edge = (background & solid) | (solid & (farthest - nearest > self.truncation))
        # Beside the object the background takes its neighbours' depth, so that interpolation does not reach behind.
        around = cv2.blur(depth, (3, 3)) / np.maximum(cv2.blur(solid.astype(np.float32), (3, 3)), 1e-6)
        empty = (cv2.erode((~solid).astype(np.uint8), box) > 0).astype(np.float32)

        x = (np.arange(width, dtype=np.float32) + 0.5 - self.camera.cx) / self.camera.fx
        y = (np.arange(height, dtype=np.float32) + 0.5 - self.camera.cy) / self.camera.fy
        rays = np.stack(np.broadcast_arrays(x, y[:, None], np.float32(1)), axis=-1).astype(np.float32)
        local = rays * depth[..., None]
        self.points = local[solid] @ camera.world_to_camera[:3, :3] + camera.position
        across, along = np.gradient(np.where(solid, depth, around), axis=(1, 0))
        filled = np.where(solid, depth, around)[..., None]
        du = rays * across[..., None] + filled * np.float32([1 / self.camera.fx, 0, 0])
        dv = rays * along[..., None] + filled * np.float32([0, 1 / self.camera.fy, 0])
        normal = np.cross(du, dv)
        facing = np.abs((normal * rays).sum(-1)) / np.maximum(np.linalg.norm(normal, axis=-1), 1e-20)
        # `facing` is the surface's distance per unit of depth: the cosine, times the length of the ray per unit depth.
        cosine = facing / np.linalg.norm(rays, axis=-1)
        facing = np.maximum(facing, 0.1)
        # OpenCV samples four channels at most at a time.
        self.maps = [
            np.dstack(maps).astype(np.float32) for maps in ((filled[..., 0], solid, edge, empty), (facing, cosine))
        ]

    def vote(self, points: np.ndarray, total: np.ndarray, weight: np.ndarray) -> None:
        """Add this view's weighted distances, in truncations, to those of the voxels at `points` (N, 3)."""
        pixels, z = project(self.camera, points)
        seen = np.flatnonzero(inside(self.camera, pixels, z))
        pixels, z = pixels[seen], z[seen]
        depth, solid, edge, empty, facing, cosine = np.concatenate(
            [sample(maps, pixels, clamp=True) for maps in self.maps], axis=1
        ).T
        metric = depth - z
        # Point to plane, not along the ray: a slanted surface is nearer than it looks.
        signed = metric * facing / self.truncation
        surface = (solid > 0.5) & (signed > -1) & (metric > -3 * self.truncation)
        surface &= (edge < 0.01) | (signed < 1)
        vote = np.where(surface, cosine * np.clip(1 + signed, 0, 1), 0)
        vote[edge > 0.01] *= _EDGE_WEIGHT
        carve = empty > 0.99
        vote[carve] = 1
        signed[carve] = 1
        weight[seen] += vote
        total[seen] += vote * np.minimum(signed, 1)
