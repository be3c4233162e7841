"""The surface of surfels as a mesh: depth maps of the cameras that saw them, fused."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.geometry.mesh import Mesh
from refgs.geometry.tsdf import fuse
from refgs.model.surfels import Surfels
from refgs.render.rasterize import rasterize
from refgs.render.volume import discs

DENSER = 4  # times the optical depth
COVERED = 1e-6  # alpha below which there is no depth


@torch.no_grad()
def extract(
    surfels: Surfels, cameras: Sequence[Camera], near: float, centre: np.ndarray, radius: float, resolution: int
) -> tuple[Mesh, float]:
    """The surface that surfels show to cameras inside the cube of half-side `radius` about `centre`: as `refgs.geometry.tsdf.fuse`
    makes it, not cleaned. Voxels are 2 `radius` / `resolution` wide, but no finer than pixels are there, in the median; how wide comes with
    it. Surfels nearer than `near` (world units) are not seen."""
    maps = [_depth_and_alpha(surfels, camera, near) for camera in cameras]
    depths, alphas = zip(*maps, strict=True)
    pixels = []
    for depth, alpha, camera in zip(depths, alphas, cameras, strict=True):
        middle = float(camera.world_to_camera[2, :3] @ centre + camera.world_to_camera[2, 3])
        solid = depth[(alpha > 0.5) & ((depth - middle).abs() < radius)]
        if len(solid):
            pixels.append(float(solid.median()) / camera.fx)
    across = min(resolution, max(int(2 * radius / float(np.median(pixels))), 1)) if pixels else resolution
    return fuse(depths, alphas, cameras, centre, radius, across), 2 * radius / across


def _depth_and_alpha(surfels: Surfels, camera: Camera, near: float) -> tuple[Tensor, Tensor]:
    """How far the surface is (H, W), along the camera's axis, and what it covers (H, W).

    What is blended at a pixel lies behind the surface in part, faint as it is there: its mean depth is too large, by a percent of
    the object's size. Of surfels that were so many times denser the mean is nearer to where the ray comes in.
    """
    *geometry, opacities = discs(surfels, camera)
    feature = opacities[:, None]
    alpha = rasterize(*geometry, opacities, feature, camera, near).alpha
    dense = rasterize(*geometry, 1 - (1 - opacities) ** DENSER, feature, camera, near)
    return dense.depth / dense.alpha.clamp_min(COVERED), alpha
