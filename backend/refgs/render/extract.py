"""Extract a mesh from surfels: render a depth map for each camera, and fuse the depth maps."""

from collections.abc import Sequence

import numpy as np
import torch

from refgs.camera import Camera
from refgs.formats.mesh import Mesh
from refgs.geometry.project import inside, project
from refgs.geometry.tsdf import fuse
from refgs.model.surfels import Surfels
from refgs.render.rasterize import trimmed_depth
from refgs.render.volume import discs

UPPER, LOWER = 0.75, 0.25  # transmittance: the surface is where it falls from the one to the other
REACH = 2.0  # radii of the region of interest: as far as its surroundings may be part of what most photos show
SHOWN = 0.5  # part of the cameras that have these in the picture
NEARLY_ALL = 0.99  # of the surfels: what the cube holds


@torch.no_grad()
def extract(
    surfels: Surfels, cameras: Sequence[Camera], near: float, centre: np.ndarray, radius: float, resolution: int
) -> tuple[Mesh, float]:
    """Fuse depth maps of the surfels from all cameras into a mesh. Return the mesh, not yet cleaned, and the width of a voxel.

    Only surfels in the foreground are drawn. These are all surfels in the region of interest, which is the ball of `radius` about `centre`.
    A surfel within twice that radius belongs to the foreground, too, if at least half of the cameras have it in the picture.

    `resolution` is the number of voxels across the foreground. There are fewer if voxels would be narrower than a typical pixel at the
    surface. Surfels nearer to a camera than `near` (world units) are not drawn.
    """
    shown, half = _foreground(surfels.positions.numpy(force=True), cameras, centre, radius)
    surfels = surfels.chosen(torch.from_numpy(shown).to(surfels.positions.device))
    maps = (trimmed_depth(*discs(surfels, camera), camera, near, UPPER, LOWER) for camera in cameras)
    # Keep a byte of each alpha: maps of all cameras of a large capture take gigabytes.
    depths, solids = zip(*((depth, alpha >= 0.5) for depth, alpha in maps), strict=True)
    pixels = []
    for depth, opaque, camera in zip(depths, solids, cameras, strict=True):
        middle = float(camera.world_to_camera[2, :3] @ centre + camera.world_to_camera[2, 3])
        solid = depth[opaque & ((depth - middle).abs() < half)]
        if len(solid):
            pixels.append(float(solid.median()) / camera.fx)
    across = min(resolution, max(int(2 * half / float(np.median(pixels))), 1)) if pixels else resolution
    return fuse(depths, solids, cameras, centre, half, across), 2 * half / across


def _foreground(
    points: np.ndarray, cameras: Sequence[Camera], centre: np.ndarray, radius: float
) -> tuple[np.ndarray, float]:
    """Mark the foreground points (N,), and find half the side of their cube about `centre`."""
    distance = np.linalg.norm(points - centre, axis=1)
    shows = np.mean([inside(camera, *project(camera, points)) for camera in cameras], axis=0)
    shown = (distance < radius) | ((distance < REACH * radius) & (shows >= SHOWN))
    if not shown.any():
        return shown, radius
    return shown, max(radius, float(np.quantile(np.abs(points[shown] - centre).max(axis=1), NEARLY_ALL)))
