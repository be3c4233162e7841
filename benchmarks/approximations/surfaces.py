"""The voxels of TSDF fusion, against shapes whose distance is known."""

from collections.abc import Iterator

import numpy as np
import torch

from benchmarks.approximations import Row, rms, timed
from benchmarks.distances import around, box, depth, torus
from refgs.geometry.tsdf import fuse

RADIUS = 1.3


def voxels(settings: tuple = (32, 64, 128, 192, 256, 384), views: int = 24, pixels: int = 256) -> Iterator[Row]:
    """Voxels across the cube, exact depth maps from all around: RMS distance of vertices from the surface, whose radius is about 1."""
    cameras = around(views, pixels)
    for shape in (box, torus):
        maps = [depth(camera, shape) for camera in cameras]
        depths, alphas = ([torch.from_numpy(map) for map in part] for part in zip(*maps, strict=True))
        for resolution in settings:
            given = depths, alphas, cameras, np.array([0.05, 0, 0]), RADIUS, resolution
            mesh, spent = timed(fuse, *given, seconds=0)
            error = rms(shape(mesh.vertices))
            yield Row("voxels across", shape.__name__, resolution, error, "RMS distance", spent, resolution == 256)
