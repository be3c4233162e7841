"""Define a rotated box, which marks the part of a capture that the user wants to reconstruct."""

from dataclasses import dataclass

import numpy as np

from refgs.settings import RegionSettings


@dataclass(frozen=True, eq=False)
class Box:
    """Hold a box with any position, size and rotation.

    `matrix` (4, 4) maps the cube from −1 to 1 onto the box. Its first three columns are half of the edge vectors, its last is the centre.
    """

    matrix: np.ndarray

    @classmethod
    def of(cls, region: RegionSettings) -> "Box":
        """Make a box from the settings' centre, edge lengths, and XYZ Euler angles in degrees."""
        from scipy.spatial.transform import Rotation  # slow to import, and few captures have a region

        turn = Rotation.from_euler("xyz", region.rotation, degrees=True).as_matrix()
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = turn * np.array(region.size) / 2, region.centre
        return cls(matrix)

    def moved(self, to_frame: np.ndarray) -> "Box":
        """Return the box in new world coordinates p_new = to_frame @ p_old."""
        return Box(to_frame @ self.matrix)

    @property
    def centre(self) -> np.ndarray:
        return self.matrix[:3, 3]

    @property
    def radius(self) -> float:
        """Return half the length of the box's diagonal."""
        return float(np.linalg.norm(self.matrix[:3, :3]))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Mark the points (N, 3) that lie in the box, as bool (N,)."""
        inverse = np.linalg.inv(self.matrix)
        return np.all(np.abs(points @ inverse[:3, :3].T + inverse[:3, 3]) <= 1, axis=-1)

    def grid(self, side: int) -> np.ndarray:
        """Return a regular grid of points (side³, 3) over the box, corners included."""
        axis = np.linspace(-1, 1, side)
        cube = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        return cube @ self.matrix[:3, :3].T + self.centre
