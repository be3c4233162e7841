"""Turn splats to the axes of another program, with their colours by direction."""

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from refgs.formats.splats import Splats, quaternion_product
from refgs.model.harmonics import basis

DEGREE = 3


def turned(splats: Splats, rotation: np.ndarray) -> Splats:
    """Return splats turned by a rotation matrix (3, 3) about the origin. Spherical harmonics turn with them."""
    quaternion = Rotation.from_matrix(rotation).as_quat()[[3, 0, 1, 2]]
    harmonics = _turned_harmonics(rotation)

    def by_direction(values: np.ndarray) -> np.ndarray:
        count = values.shape[1]
        return (harmonics[:count, :count] @ values).astype(np.float32)

    return replace(
        splats,
        positions=(splats.positions @ rotation.T).astype(np.float32),
        normals=(splats.normals @ rotation.T).astype(np.float32),
        rotations=quaternion_product(quaternion, splats.rotations).astype(np.float32),
        sh=by_direction(splats.sh),
        indirect=by_direction(splats.indirect),
    )


def _turned_harmonics(rotation: np.ndarray) -> np.ndarray:
    """Return the matrix (16, 16) that turns coefficients of spherical harmonics. Degrees do not mix, so that lower ones are its corner."""
    # A turned function has in a direction the value that the function had in the direction turned back.
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    after, before = (basis(torch.from_numpy(d), DEGREE).numpy() for d in (directions, directions @ rotation))
    return np.linalg.lstsq(after, before, rcond=None)[0]
