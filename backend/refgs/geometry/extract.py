"""The surface of surfels as a mesh: depth maps of the cameras that saw them, fused."""

from collections.abc import Callable, Sequence

import numpy as np

from refgs.camera import Camera
from refgs.geometry.mesh import Mesh
from refgs.geometry.tsdf import fuse
from refgs.render.renderer import Rendering


def extract(
    render: Callable[[Camera], Rendering],
    cameras: Sequence[Camera],
    centre: np.ndarray,
    radius: float,
    resolution: int,
) -> Mesh:
    """The surface that the cameras' renderings, made without gradients, show inside the cube of half-side `radius` about
    `centre`, in voxels of 2 `radius` / `resolution`: as `refgs.geometry.tsdf.fuse` makes it, not cleaned."""
    depths, alphas = [], []
    for camera in cameras:  # a rendering is nine times as large as what is kept of it
        rendering = render(camera)
        depths.append(rendering.depth)
        alphas.append(rendering.alpha)
    return fuse(depths, alphas, cameras, centre, radius, resolution)
