"""Define pinhole cameras in OpenCV's convention."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np


@dataclass(frozen=True, eq=False)
class Camera:
    """Hold a pinhole camera without distortion, in OpenCV's convention: x right, y down, z forward.

    A world point p is seen at pixel (fx·x/z + cx, fy·y/z + cy), where (x, y, z, 1) = world_to_camera @ (p, 1). `world_to_camera` is a rigid
    4×4 float64 matrix. Focal lengths and principal point are in pixels, and pixel centres are at half-integers.
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
        """Return the 4×4 camera-to-world matrix: axes right, down and forward, then the position."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        matrix = np.eye(4)
        matrix[:3, :3] = rotation.T
        matrix[:3, 3] = -rotation.T @ translation
        return matrix

    @cached_property
    def position(self) -> np.ndarray:
        """Return the camera's position in the world, (3,)."""
        return self.camera_to_world[:3, 3]

    @cached_property
    def projection(self) -> np.ndarray:
        """Return the projection matrix (3, 4).

        It maps a homogeneous world point (x, y, z, 1) to (u·d, v·d, d), where (u, v) is the pixel and d the depth.
        """
        intrinsics = np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])
        return intrinsics @ self.world_to_camera[:3]

    @cached_property
    def heading(self) -> float:
        """Return the compass direction that the camera looks in: an angle about the world's z axis, in radians.

        It is 0 for a level camera that looks along +y, and grows counter-clockwise seen from above. Tilting or rolling a level camera does
        not change it. It depends on the camera's forward and right axes, so it is also defined for a camera that looks straight down.
        """
        right, _, forward = self.camera_to_world[:3, :3].T
        return float(np.arctan2(right[1] - forward[0], right[0] + forward[1]))

    def resized(self, width: int, height: int) -> "Camera":
        """Return the camera for its image scaled to `width` × `height` pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def cropped(self, left: int, top: int, width: int, height: int) -> "Camera":
        """Return the camera for a crop of its image, given in pixels."""
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top)

    def turned(self) -> "Camera":
        """Return the camera for its image turned clockwise by a quarter turn."""
        roll = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        return replace(
            self,
            width=self.height,
            height=self.width,
            fx=self.fy,
            fy=self.fx,
            cx=self.height - self.cy,
            cy=self.cx,
            world_to_camera=roll @ self.world_to_camera,
        )

    def fitted(self, max_side: int) -> "Camera":
        """Return the camera for its image, scaled down until no side exceeds `max_side` pixels."""
        scale = max_side / max(self.width, self.height)
        if scale >= 1:
            return self
        return self.resized(max(1, round(self.width * scale)), max(1, round(self.height * scale)))
