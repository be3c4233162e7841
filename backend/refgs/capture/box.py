"""The box that holds what of a capture is wanted."""

from dataclasses import dataclass

import numpy as np

from refgs.settings import RegionSettings


@dataclass(frozen=True, eq=False)
class Box:
    """A box in some frame: `matrix` (4, 4) takes the cube −1..1 there, its columns are half the box's edges and its centre."""

    matrix: np.ndarray

    @classmethod
    def of(cls, region: RegionSettings) -> "Box":
        """The box that settings describe."""
        from scipy.spatial.transform import Rotation  # slow to import, and few captures have a region

        turn = Rotation.from_euler("xyz", region.rotation, degrees=True).as_matrix()
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = turn * np.array(region.size) / 2, region.centre
        return cls(matrix)

    def moved(self, to_frame: np.ndarray) -> "Box":
        """The box seen from another frame: p_new = to_frame @ p_old."""
        return Box(to_frame @ self.matrix)

    @property
    def centre(self) -> np.ndarray:
        return self.matrix[:3, 3]

    @property
    def radius(self) -> float:
        """Half the box's diagonal."""
        return float(np.linalg.norm(self.matrix[:3, :3]))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which points (N, 3) lie in the box (N,)."""
        inverse = np.linalg.inv(self.matrix)
        return (np.abs(points @ inverse[:3, :3].T + inverse[:3, 3]) <= 1).all(axis=-1)

    def grid(self, side: int) -> np.ndarray:
        """Points (side³, 3) spread evenly over the box, its corners among them."""
        axis = np.linspace(-1, 1, side)
        cube = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        return cube @ self.matrix[:3, :3].T + self.centre
