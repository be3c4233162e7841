"""Hold a shape as signed distances on a grid of cubic voxels. Trace rays through it, and mesh it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs
from skimage.measure import marching_cubes
from torch import Tensor
from torch.nn.functional import grid_sample

from refgs.formats.mesh import SmoothMesh
from refgs.geometry.shape import Shape

SIDE = 96  # voxels along the longest side
_PAD = 3  # empty voxels on each side
_NEAR = 3.5  # voxels from the surface: distances are exact there
_STEPS = 64  # of a ray towards the surface
_CHUNK = 65536  # rays that are traced at a time


@dataclass(frozen=True, eq=False)
class Field:
    """Hold a shape's signed distances, `values` (X, Y, Z), in voxels; negative inside.

    The first value is at the position `low` (3,); a voxel's side is `voxel`, in world units. Positions "in voxels" are
    (world position − `low`) / `voxel`.
    """

    values: np.ndarray
    low: np.ndarray
    voxel: float

    @staticmethod
    def of(alpha: np.ndarray, low: np.ndarray, voxel: np.ndarray) -> "Field":
        """Compute the distances from a surface, which is where `alpha` (X, Y, Z) is one half.

        Voxels of `alpha` have the size `voxel` (3,), and the first has its corner at `low` (3,). The field has SIDE voxels along the
        longest side of this grid. A shape thinner than its voxels may be lost.
        """
        size = np.array(alpha.shape) * voxel
        side = float(size.max()) / (SIDE - 2 * _PAD)
        shape = np.ceil(size / side).astype(int) + 2 * _PAD
        first = low + size / 2 - side * (shape - 1) / 2
        smooth = gaussian_filter(alpha, 0.6 * side / voxel)
        at = np.meshgrid(
            *((first[a] + side * np.arange(shape[a]) - low[a]) / voxel[a] - 0.5 for a in range(3)), indexing="ij"
        )
        return Field(_distances(np.asarray(map_coordinates(smooth, at, order=1))), first, side)

    @cached_property
    def shape(self) -> Shape:
        """Return the voxels inside."""
        return Shape(self.values < 0, self.low - self.voxel / 2, np.full(3, self.voxel))

    @cached_property
    def tensor(self) -> Tensor:
        """Return the distances as a tensor (1, X, Y, Z)."""
        return torch.from_numpy(self.values)[None]

    @cached_property
    def gradient(self) -> np.ndarray:
        """Return the outward direction (3, X, Y, Z) of the distances' gradient, of any length."""
        # Voxels' distances are noisy: smooth them, and only those near the surface.
        smooth = gaussian_filter(self.values.clip(-1, 1), 1.0)
        return np.stack(np.gradient(smooth))

    def mesh(self) -> SmoothMesh:
        """Mesh the surface, with positions in voxels."""
        vertices, faces, _, _ = marching_cubes(np.pad(self.values, 1, constant_values=1.0), 0.0)
        vertices = vertices - 1
        normals = np.stack([map_coordinates(part, vertices.T, order=1, mode="nearest") for part in self.gradient], 1)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
        return SmoothMesh(vertices, faces, normals)

    def enter(self, origin: Tensor, direction: Tensor, skin: float) -> tuple[Tensor, Tensor]:
        """Return the distances (N,) at which rays enter the shape first, and leave it last, both in voxels.

        `origin` (N, 3) is in voxels, and `direction` (N, 3) has unit length. The shape is enlarged by `skin` voxels. Distances are NaN for
        rays that miss it.
        """
        last = torch.tensor(self.values.shape) - 1.0
        inverse = 1 / torch.where(direction.abs() < 1e-9, 1e-9, direction)
        a, b = -origin * inverse, (last - origin) * inverse
        first, end = torch.minimum(a, b).amax(1).clamp(min=0), torch.maximum(a, b).amin(1)
        near = self._march(origin, direction, first, end, skin)
        far = end - self._march(origin + direction * end[:, None], -direction, torch.zeros_like(end), end - near, skin)
        return near, torch.fmax(near, far)  # a grazing ray may miss on its way back

    def _march(self, origin: Tensor, direction: Tensor, start: Tensor, end: Tensor, skin: float) -> Tensor:
        """Return the distance (N,) from which on rays are within `skin` of the shape, NaN if they never are."""
        found = torch.full_like(start, torch.nan)
        for rays in torch.arange(len(start)).split(_CHUNK):
            away = start[rays]
            for _ in range(_STEPS):
                going = away <= end[rays]  # false for NaN
                rays, away = rays[going], away[going]
                step = sample(self.tensor, origin[rays] + direction[rays] * away[:, None])[:, 0] - skin
                met = step < 0.05
                found[rays[met]] = away[met]
                rays, away = rays[~met], away[~met] + step[~met].clamp(min=0.25)
        return found


def sample(grid: Tensor, at: Tensor) -> Tensor:
    """Interpolate a grid (C, X, Y, Z) at positions (N, 3) in voxels, linearly. Returns (N, C). Outside, the nearest value counts."""
    last = torch.tensor(grid.shape[1:]) - 1.0
    at = (2 * at / last - 1).flip(-1)[None, None, None]
    return grid_sample(grid[None], at, align_corners=True, padding_mode="border")[0, :, 0, 0].T


def _distances(field: np.ndarray) -> np.ndarray:
    """Return the signed distances (X, Y, Z), in voxels, from the surface where `field` is one half."""
    solid = field > 0.5
    outside, inside = (np.asarray(distance_transform_edt(part)) for part in (~solid, solid))
    away = np.where(solid, 0.5 - inside, outside - 0.5).astype(np.float32)
    if not solid.any():
        return np.full_like(away, np.inf)
    vertices, faces, _, _ = marching_cubes(field, 0.5)
    corners = vertices[faces]
    points = np.concatenate(
        [vertices, corners.mean(axis=1), *((corners + np.roll(corners, 1, axis=1)) / 2).swapaxes(0, 1)]
    )
    near = np.abs(away) < _NEAR
    away[near] = np.where(solid[near], -1, 1) * cKDTree(points).query(np.argwhere(near))[0]
    return away
