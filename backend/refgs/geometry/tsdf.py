"""A mesh from depth maps: truncated signed distance fusion (Curless and Levoy 1996, "A Volumetric Method for Building
Complex Models from Range Images"), in a band about the surface."""

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
_CHUNK = 4096  # blocks projected at a time, so that they stay in the cache
_EDGE_WEIGHT = 0.1  # of a pixel beside a jump in depth or alpha; at 1 a sphere comes out a tenth of a voxel too large
_LEAST_WEIGHT = 0.02  # a voxel with less was hardly seen: no surface is made beside it


@torch.no_grad()
def fuse(
    depths: Sequence[Tensor],
    alphas: Sequence[Tensor],
    cameras: Sequence[Camera],
    centre: np.ndarray,
    radius: float,
    resolution: int,
) -> Mesh:
    """The surface that depth maps agree on, inside the cube of half-side `radius` about `centre`.

    `depths` (H, W) are distances along the camera's axis in world units, already divided by alpha; `alphas` (H, W) in
    0..1, float32 and all on one device, where they are fused. A pixel with alpha below a half is background: all that its
    ray passes is empty. So the silhouettes of a masked object carve, and a capture without masks, whose alpha is 1, is left
    alone. Pixels beside a jump in depth or alpha count for little, and say where the surface is but not that what lies
    before it is empty: there the ray may have missed a neighbour by half a pixel.

    Only voxels within two blocks of a pixel's depth are looked at and kept, so time and memory follow the surface and not the cube.
    The result has outward faces, is open where nothing was seen, and has no faces where there is no surface.
    """
    voxel = 2 * radius / resolution
    low = np.asarray(centre, np.float64) - radius
    blocks = -(-resolution // _BLOCK)
    met = [
        _blocks_of_pixels(depth, alpha, camera, low, voxel * _BLOCK, blocks)
        for depth, alpha, camera in zip(depths, alphas, cameras, strict=True)
    ]
    block = _with_neighbours(torch.cat(met), blocks)
    votes = torch.zeros(2, len(block), _BLOCK**3, device=block.device)
    for depth, alpha, camera in zip(depths, alphas, cameras, strict=True):
        view = _View(depth, alpha, camera, low, voxel)
        for part, (total, weight) in zip(block.split(_CHUNK), votes.split(_CHUNK, dim=1), strict=True):
            view.vote(part, total, weight)
    total, weight = votes
    seen = weight > _LEAST_WEIGHT
    signed = torch.where(seen, total / weight.clamp_min(1e-20), torch.nan)
    mesh = isosurface(block.cpu().numpy(), signed.cpu().numpy())  # from here on the CPU: marching cubes is its
    return Mesh(mesh.vertices * voxel + low + 0.5 * voxel, mesh.faces)


def _with_neighbours(block: Tensor, blocks: int) -> Tensor:
    """Blocks (M, 3) and those around them, each once, of a cube of so many along each side."""
    step = torch.arange(-1, 2, device=block.device)
    around = (_each(block, blocks)[:, None] + torch.cartesian_prod(step, step, step)).view(-1, 3)
    return _each(around[((around >= 0) & (around < blocks)).all(dim=-1)], blocks)


def _each(block: Tensor, blocks: int) -> Tensor:
    """Blocks (M, 3), each once, in order."""
    number = ((block[:, 0] * blocks + block[:, 1]) * blocks + block[:, 2]).unique()
    return torch.stack([number // blocks**2, number // blocks % blocks, number % blocks], dim=-1)


def _on(like: Tensor, numbers: np.ndarray) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float32).to(like.device)


def _rays(camera: Camera, like: Tensor) -> Tensor:
    """Directions (H, W, 3) through the pixels' centres in the camera's own frame, of depth 1."""
    x = (torch.arange(camera.width, device=like.device) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, device=like.device) + 0.5 - camera.cy) / camera.fy
    return torch.stack([x.expand_as(like), y[:, None].expand_as(like), torch.ones_like(like)], dim=-1)


def _solid(depth: Tensor, alpha: Tensor) -> Tensor:
    return (alpha >= 0.5) & depth.isfinite() & (depth > 0)


def _blocks_of_pixels(
    depth: Tensor, alpha: Tensor, camera: Camera, low: np.ndarray, side: float, blocks: int
) -> Tensor:
    """The blocks (M, 3) that pixels' depths are in, each once."""
    camera, solid = camera.resized(*depth.shape[::-1]), _solid(depth, alpha)
    local = _rays(camera, depth)[solid] * depth[solid][:, None]
    to_block = _on(depth, camera.world_to_camera[:3, :3] / side)
    cell = (local @ to_block + _on(depth, (camera.position - low) / side)).floor()
    return _each(cell[((cell >= 0) & (cell < blocks)).all(dim=-1)].long(), blocks)


class _View:
    """What one depth map says about voxels."""

    def __init__(self, depth: Tensor, alpha: Tensor, camera: Camera, low: np.ndarray, voxel: float):
        self.camera = camera = camera.resized(*depth.shape[::-1])
        self.truncation = _TRUNCATION * voxel
        # From a voxel's index to a pixel's position times depth, and the depth.
        matrix = camera.projection
        self.first = _on(depth, matrix[:, :3] @ (low + 0.5 * voxel) + matrix[:, 3])
        self.step = _on(depth, matrix[:, :3] * voxel)

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
        # Beside the object the background takes its neighbours' depth, so that interpolation does not reach behind.
        filled = torch.where(solid, depth, mean(depth) / mean(solid.float()).clamp_min(1e-6))

        rays = _rays(camera, depth)
        along, across = torch.gradient(filled)
        du, dv = rays * across[..., None], rays * along[..., None]
        du[..., 0] += filled / camera.fx
        dv[..., 1] += filled / camera.fy
        normal = torch.linalg.cross(du, dv)
        facing = (normal * rays).sum(dim=-1).abs() / normal.norm(dim=-1).clamp_min(1e-20)
        # `facing` is the surface's distance per unit of depth: the cosine, times the length of the ray per unit depth.
        cosine = facing / rays.norm(dim=-1)
        self.maps = torch.stack([filled, solid, edge, empty, facing.clamp_min(0.1), cosine])

    def vote(self, block: Tensor, total: Tensor, weight: Tensor) -> None:
        """Add this view's weighted distances, in truncations, to those (M, voxels of a block) of the blocks (M, 3)."""
        x, y, z = self._project(block)
        inverse = 1 / torch.where(z.abs() > 1e-12, z, 1e-12)
        # -1..1 over the picture, whose pixels have their centres at half-integers
        at = torch.stack(
            [x * inverse * (2 / self.camera.width) - 1, y * inverse * (2 / self.camera.height) - 1], dim=-1
        )
        inside = (z > 0) & (at.abs() <= 1).all(dim=-1)
        maps = self.maps.expand(len(block), -1, -1, -1)
        sampled = grid_sample(maps, at[:, None], padding_mode="border", align_corners=False)
        depth, solid, edge, empty, facing, cosine = sampled[:, :, 0].unbind(dim=1)
        metric = depth - z
        # Point to plane, not along the ray: a slanted surface is nearer than it looks.
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
        """Pixel positions times depth, and depths (3, M, voxels of a block)."""
        index = torch.arange(_BLOCK, device=block.device, dtype=torch.float32)
        offset = torch.cartesian_prod(index, index, index) @ self.step.T
        corner = (_BLOCK * block).float() @ self.step.T + self.first
        return corner.T[:, :, None] + offset.T[:, None]
