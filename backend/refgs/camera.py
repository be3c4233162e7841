"""Define pinhole cameras in OpenCV's convention."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np


@dataclass(frozen=True, eq=False)
class Camera:
    """Pinhole camera without distortion: x right, y down, z forward; pixel centres at half-integers.

    A world point p is seen at pixel (fx·x/z + cx, fy·y/z + cy), where (x, y, z, 1) = world_to_camera @ (p, 1).
    `world_to_camera` is a rigid 4×4 float64 matrix; focal lengths and principal point are in pixels.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: np.ndarray

    @cached_property
    def camera_to_world(self) -> np.ndarray:
        """Rigid 4×4 matrix; its columns are the camera's right, down and forward axes and its position."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        matrix = np.eye(4)
        matrix[:3, :3] = rotation.T
        matrix[:3, 3] = -rotation.T @ translation
        return matrix

    @cached_property
    def position(self) -> np.ndarray:
        """Camera centre in the world, (3,)."""
        return self.camera_to_world[:3, 3]

    @cached_property
    def projection(self) -> np.ndarray:
        """Matrix (3, 4) from a world point (x, y, z, 1) to (column · depth, row · depth, depth)."""
        intrinsics = np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])
        return intrinsics @ self.world_to_camera[:3]

    @cached_property
    def heading(self) -> float:
        """Rotation about the world's z in radians: the twist of the rotation's swing-twist decomposition.

        Zero for a level camera that looks along +y. Tilting, rolling or raising the camera does not change it.
        """
        right, _, forward = self.camera_to_world[:3, :3].T
        return float(np.arctan2(right[1] - forward[0], right[0] + forward[1]))

    def resized(self, width: int, height: int) -> "Camera":
        """Return the camera for an image of another size in pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def cropped(self, left: int, top: int, width: int, height: int) -> "Camera":
        """Return the camera for a crop of its image: `width` × `height` pixels from column `left` and row `top`."""
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top)

    def fitted(self, max_side: int) -> "Camera":
        """Return the camera with its longer side reduced to `max_side` pixels; unchanged if it is not longer."""
        scale = max_side / max(self.width, self.height)
        if scale >= 1:
            return self
        return self.resized(max(1, round(self.width * scale)), max(1, round(self.height * scale)))
