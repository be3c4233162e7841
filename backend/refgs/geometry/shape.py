"""Hold a photo with its mask, and a part of space made of voxels."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from refgs.camera import Camera


class Photo(NamedTuple):
    """Hold a photo's `image` (H, W, 3), uint8 mask `alpha`, camera and white value."""

    image: np.ndarray
    alpha: np.ndarray
    camera: Camera
    white: int


@dataclass(frozen=True, eq=False)
class Shape:
    """Hold a part of space, made of voxels, in which a surface must lie.

    `solid` (X, Y, Z), bool, tells which voxels belong to it. The first voxel has the corner `low` (3,) and the size `voxel` (3,).
    """

    solid: np.ndarray
    low: np.ndarray
    voxel: np.ndarray

    @cached_property
    def ball(self) -> tuple[np.ndarray, float]:
        """Return the centre (3,) and the radius of a ball around the shape."""
        voxels = np.argwhere(self.solid)
        first, last = self.low + voxels.min(axis=0) * self.voxel, self.low + (voxels.max(axis=0) + 1) * self.voxel
        return (first + last) / 2, float(np.linalg.norm(last - first)) / 2

    def fit(self, camera: Camera, across: int) -> Camera:
        """Reduce the camera, never enlarging it, until the shape's ball is `across` pixels wide."""
        return fitted(camera, *self.ball, across)


def fitted(camera: Camera, centre: np.ndarray, radius: float, across: int) -> Camera:
    """Reduce the camera, never enlarging it, until a ball is `across` pixels wide."""
    distance = float(np.linalg.norm(camera.position - centre))
    side = across * max(camera.width, camera.height) * distance / (2 * radius * camera.fx)
    return camera.fitted(max(round(side), 1))
