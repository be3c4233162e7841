"""Fuse depth maps into a mesh by truncated signed distances, stored only in voxels near the surface.

Curless and Levoy 1996, "A Volumetric Method for Building Complex Models from Range Images".
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, max_pool2d

from refgs.camera import Camera
from refgs.formats.mesh import Mesh
from refgs.geometry.isosurface import BLOCK as _BLOCK
from refgs.geometry.isosurface import isosurface

_TRUNCATION = 4.0  # voxels: 3 halves the bias at sharp corners, 5 averages more noise away
_CHUNK = 4096  # blocks projected at a time; they fit the cache
_EDGE_WEIGHT = 0.1  # weight of a pixel beside a jump in depth or alpha; with 1 a sphere is a tenth of a voxel too large
_LEAST_WEIGHT = 0.02  # least total weight of a known voxel; beside unknown ones there is no surface


@torch.no_grad()
def fuse(
    depths: Sequence[Tensor],
    alphas: Sequence[Tensor],
    cameras: Sequence[Camera],
    centre: np.ndarray,
    radius: float,
    resolution: int,
) -> Mesh:
    """Fuse depth maps into a mesh, inside the cube of half-side `radius` about `centre`, on a grid of `resolution`³ voxels.

    `depths` (H, W) are distances along the camera's axis in world units, already divided by alpha. `alphas` (H, W) are in 0..1, or booleans
    that say whether alpha is at least 0.5. All tensors are on the same device. Most of the work is done on this device.

    - A pixel with alpha below 0.5 is background: space along its whole ray is empty. So the silhouettes carve the mesh. For photos without
      masks, alpha is 1 and nothing is carved.
    - A pixel beside a jump in depth or alpha has a small weight. It affects only voxels near its surface point. It does not mark the space
      in front as empty, because its ray may have missed another surface by half a pixel.
    - Voxels are stored only in blocks near the surface points of pixels. So time and memory grow with the surface, not with the cube.

    The mesh's faces point outwards. The mesh has holes where no camera saw the surface, and it is empty if there is no surface.
    """
    voxel = 2 * radius / resolution
    low = np.asarray(centre, np.float64) - radius
    blocks = -(-resolution // _BLOCK)
    hit = [
        _blocks_of_pixels(depth, alpha, camera, low, voxel * _BLOCK, blocks)
        for depth, alpha, camera in zip(depths, alphas, cameras, strict=True)
    ]
    block = _with_neighbours(torch.cat(hit), blocks)
    votes = torch.zeros(2, len(block), _BLOCK**3, device=block.device)
    for depth, alpha, camera in zip(depths, alphas, cameras, strict=True):
        view = _View(depth, alpha, camera, low, voxel)
        for part, (total, weight) in zip(block.split(_CHUNK), votes.split(_CHUNK, dim=1), strict=True):
            view.vote(part, total, weight)
    total, weight = votes
    seen = weight > _LEAST_WEIGHT
    signed = torch.where(seen, total / weight.clamp_min(1e-20), torch.nan)
    mesh = isosurface(block.cpu().numpy(), signed.cpu().numpy())  # marching cubes runs on the CPU
    return Mesh(mesh.vertices * voxel + low + 0.5 * voxel, mesh.faces)


def _with_neighbours(block: Tensor, blocks: int) -> Tensor:
    """Add all neighbours in a `blocks`³ grid to blocks (M, 3), sorted without duplicates."""
    step = torch.arange(-1, 2, device=block.device)
    around = (_unique(block, blocks)[:, None] + torch.cartesian_prod(step, step, step)).view(-1, 3)
    return _unique(around[((around >= 0) & (around < blocks)).all(dim=-1)], blocks)


def _unique(block: Tensor, blocks: int) -> Tensor:
    """Sort blocks (M, 3) and remove duplicates. The grid has `blocks`³ blocks."""
    number = ((block[:, 0] * blocks + block[:, 1]) * blocks + block[:, 2]).unique()
    return torch.stack([number // blocks**2, number // blocks % blocks, number % blocks], dim=-1)


def _tensor_like(like: Tensor, numbers: np.ndarray) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float32).to(like.device)


def _rays(camera: Camera, like: Tensor) -> Tensor:
    """Compute pixel centres' rays (H, W, 3) in camera coordinates with z = 1."""
    x = (torch.arange(camera.width, device=like.device) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, device=like.device) + 0.5 - camera.cy) / camera.fy
    return torch.stack([x.expand_as(like), y[:, None].expand_as(like), torch.ones_like(like)], dim=-1)


def _solid(depth: Tensor, alpha: Tensor) -> Tensor:
    return (alpha >= 0.5) & depth.isfinite() & (depth > 0)


def _blocks_of_pixels(
    depth: Tensor, alpha: Tensor, camera: Camera, low: np.ndarray, side: float, blocks: int
) -> Tensor:
    """Find the blocks (M, 3) that contain a depth map's surface, sorted without duplicates."""
    camera, solid = camera.resized(*depth.shape[::-1]), _solid(depth, alpha)
    local = _rays(camera, depth)[solid] * depth[solid][:, None]
    to_block = _tensor_like(depth, camera.world_to_camera[:3, :3] / side)
    cell = (local @ to_block + _tensor_like(depth, (camera.position - low) / side)).floor()
    return _unique(cell[((cell >= 0) & (cell < blocks)).all(dim=-1)].long(), blocks)


class _View:
    """Compute voxels' signed distances to the surface in one depth map, and their weights."""

    def __init__(self, depth: Tensor, alpha: Tensor, camera: Camera, low: np.ndarray, voxel: float):
        self.camera = camera = camera.resized(*depth.shape[::-1])
        self.truncation = _TRUNCATION * voxel
        # first + step · index of a voxel = its pixel position times depth, and its depth.
        matrix = camera.projection
        self.first = _tensor_like(depth, matrix[:, :3] @ (low + 0.5 * voxel) + matrix[:, 3])
        self.step = _tensor_like(depth, matrix[:, :3] * voxel)

        def largest(map: Tensor) -> Tensor:
            return max_pool2d(map[None], 3, 1, 1)[0]

        def mean(map: Tensor) -> Tensor:
            return avg_pool2d(map[None], 3, 1, 1)[0]

        solid = _solid(depth, alpha)
        depth = torch.where(solid, depth, 0)
        nearest = -largest(-torch.where(solid, depth, torch.inf))
        background = largest((~solid).float()) > 0
        edge = (background & solid) | (solid & (largest(depth) - nearest > self.truncation))
        empty = largest(solid.float()) == 0
        # Extend the object's depth into the background beside it, so that interpolation at the border stays on the surface.
        filled = torch.where(solid, depth, mean(depth) / mean(solid.float()).clamp_min(1e-6))

        rays = _rays(camera, depth)
        along, across = torch.gradient(filled)
        du, dv = rays * across[..., None], rays * along[..., None]
        du[..., 0] += filled / camera.fx
        dv[..., 1] += filled / camera.fy
        normal = torch.linalg.cross(du, dv)
        facing = (normal * rays).sum(dim=-1).abs() / normal.norm(dim=-1).clamp_min(1e-20)
        # `facing` converts a difference in depth to a distance from the surface: the cosine, times the ray's length per unit depth.
        cosine = facing / rays.norm(dim=-1)
        self.maps = torch.stack([filled, solid, edge, empty, facing.clamp_min(0.1), cosine])

    def vote(self, block: Tensor, total: Tensor, weight: Tensor) -> None:
        """Add this depth map's signed distances, times their weights, to `total`. Add the weights to `weight`.

        Both tensors are (M, BLOCK³), for the voxels of blocks (M, 3). Distances are divided by the truncation distance.
        """
        x, y, z = self._project(block)
        inverse = 1 / torch.where(z.abs() > 1e-12, z, 1e-12)
        # grid_sample's coordinates: −1..1 over the picture
        at = torch.stack(
            [x * inverse * (2 / self.camera.width) - 1, y * inverse * (2 / self.camera.height) - 1], dim=-1
        )
        inside = (z > 0) & (at.abs() <= 1).all(dim=-1)
        maps = self.maps.expand(len(block), -1, -1, -1)
        sampled = grid_sample(maps, at[:, None], padding_mode="border", align_corners=False)
        depth, solid, edge, empty, facing, cosine = sampled[:, :, 0].unbind(dim=1)
        metric = depth - z
        # Take the distance to the surface's plane: the distance along the ray is larger where the surface is slanted.
        signed = metric * facing / self.truncation
        surface = (solid > 0.5) & (signed > -1) & (metric > -3 * self.truncation)
        surface &= (edge < 0.01) | (signed < 1)
        vote = cosine * (1 + signed).clamp(0, 1) * torch.where(edge > 0.01, _EDGE_WEIGHT, 1)
        vote = torch.where(surface, vote, 0)
        carve = empty > 0.99
        vote = torch.where(inside, torch.where(carve, 1, vote), 0)
        weight += vote
        total += vote * torch.where(carve, 1, signed.clamp_max(1))

    def _project(self, block: Tensor) -> Tensor:
        """Project the blocks' voxels to homogeneous pixel positions (3, M, BLOCK³), with depth last."""
        index = torch.arange(_BLOCK, device=block.device, dtype=torch.float32)
        offset = torch.cartesian_prod(index, index, index) @ self.step.T
        corner = (_BLOCK * block).float() @ self.step.T + self.first
        return corner.T[:, :, None] + offset.T[:, None]
