"""Trace rays against a mesh on a CUDA card."""

import numpy as np
import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.formats.mesh import Mesh
from refgs.kernels.layout import struct
from refgs.kernels.load import run

LEAF = 4  # triangles a leaf, as in trace.cu
BITS = 10  # bits a coordinate in a Morton code


_Work = struct("Trace", "trace.cu")


def _spread_bits(v: Tensor) -> Tensor:
    """Insert two zero bits between neighbouring bits of integers below 2^10."""
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        v = (v | v << shift) & mask
    return v


class Tree:
    """Hold a mesh's bounding volume hierarchy on a CUDA card. Triangles are in Morton order (Lauterbach et al. 2009).

    The tree is a complete binary tree. Vertices are stored as (vertex − `centre`) / `size`. `lift` is the height above the surface at which
    rays start, in units of `size`.
    """

    def __init__(self, mesh: Mesh, centre: np.ndarray, size: float, lift: float, device: torch.device):
        self.centre, self.size, self.lift = centre, size, lift
        corners = torch.from_numpy(((mesh.vertices[mesh.faces] - centre) / size).astype(np.float32)).to(device)
        cell = ((corners.mean(dim=1) + 1) / 2 * 2**BITS).long().clamp(0, 2**BITS - 1)
        x, y, z = (_spread_bits(v) for v in cell.unbind(-1))
        corners = corners[torch.argsort(x | y << 1 | z << 2)]
        self.leaves = 1 << max(0, (-(-len(corners) // LEAF) - 1).bit_length())
        empty = corners.new_full((self.leaves * LEAF - len(corners), 3, 3), torch.nan)
        corners = torch.cat([corners, empty])
        low = corners.nan_to_num(torch.inf).reshape(self.leaves, -1, 3).amin(dim=1)
        high = corners.nan_to_num(-torch.inf).reshape(self.leaves, -1, 3).amax(dim=1)
        levels = [torch.cat([low, high], dim=1)]
        while len(levels[0]) > 1:
            low, high = levels[0].split(3, dim=1)
            pairs = low.reshape(-1, 2, 3).amin(dim=1), high.reshape(-1, 2, 3).amax(dim=1)
            levels.insert(0, torch.cat(pairs, dim=1))
        self._boxes = torch.cat([levels[0], *levels]).contiguous()  # the root has index 1: entry 0 is unused
        edges = corners[:, 1:] - corners[:, :1]
        self._triangles = torch.cat([corners[:, :1], edges], dim=1).contiguous()

    def visible(self, mirrored: Tensor, alpha: Tensor, depth: Tensor, camera: Camera) -> Tensor:
        """Trace a ray from each pixel's surface point in its mirror direction. Returns (H, W): 0 if the mesh blocks the ray, otherwise 1.

        Empty pixels have 1. `mirrored` (H, W, 3) are the rays' unit directions. `depth` (H, W) is the blended depth, not yet divided by
        `alpha` (H, W).
        """
        mirrored, alpha, depth = (v.detach().contiguous() for v in (mirrored, alpha, depth))
        visible, work = torch.empty_like(alpha), _Work(width=camera.width, height=camera.height, leaves=self.leaves)
        work.view[:], work.camera[:] = camera.world_to_camera[:3].reshape(-1).tolist(), camera.position.tolist()
        work.fx, work.fy, work.cx, work.cy = camera.fx, camera.fy, camera.cx, camera.cy
        work.centre[:], work.size, work.lift = self.centre.tolist(), self.size, self.lift
        work.attach(mirrored=mirrored, alpha=alpha, depth=depth, visible=visible)
        work.attach(boxes=self._boxes, triangles=self._triangles)
        run("refgs_trace", work, alpha, items=alpha.numel())
        return visible
