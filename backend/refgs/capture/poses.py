"""Check camera poses, and move cameras to other world coordinates."""

from dataclasses import replace

import numpy as np

from refgs.camera import Camera
from refgs.errors import InputError
from refgs.formats.colmap import FARTHEST

# OpenGL camera axes (y up, looking along −z) to OpenCV's (y down, looking along +z), and back.
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def world_to_camera(camera_to_world: object, where: str) -> np.ndarray:
    """Check a camera-to-world matrix (4×4 or 3×4) from a file, and return its inverse: a rigid world-to-camera matrix, (4, 4) float64.

    The axis convention stays that of the input. A uniform scale is dropped, because the camera sees the same without it. The rotation is
    made orthonormal. Raises InputError for NaN, for a position too far away, for a singular matrix, for a reflection, and for a stretch of
    more than 1 %. The message begins with `where`, a name for the camera.
    """
    advice = "Export the cameras again, or remove this frame."
    try:
        matrix = np.array(camera_to_world, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise InputError(f"{where}: the pose is not a 4×4 matrix of numbers. {advice}")
    if not np.isfinite(matrix).all():
        raise InputError(f"{where}: the pose holds NaN or infinity. {advice}")
    rotation, position = matrix[:3, :3], matrix[:3, 3]
    if np.abs(position).max() > FARTHEST:
        raise InputError(
            f"{where}: the pose is {np.abs(position).max():.3g} from the origin, which is too far. {advice}"
        )
    u, stretch, vt = np.linalg.svd(rotation)
    if stretch[2] <= max(1e-9 * stretch[0], 1e-100) or (
        len(matrix) == 4 and not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6)
    ):
        raise InputError(f"{where}: the pose matrix cannot be inverted to a rigid pose. {advice}")
    if np.linalg.det(u @ vt) < 0:
        raise InputError(f"{where}: the pose is left-handed (it mirrors the world). {advice}")
    if stretch[0] > 1.01 * stretch[2]:
        raise InputError(f"{where}: the pose stretches or skews by {stretch[0] / stretch[2] - 1:.0%}. {advice}")
    inverse: np.ndarray = (u @ vt).T
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = inverse, -inverse @ position
    return result


def split_similarity(matrix: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Split a 4×4 similarity into its scale, rotation (3, 3) and translation (3,)."""
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    return scale, matrix[:3, :3] / scale, matrix[:3, 3]


def in_frame(camera: Camera, to_frame: np.ndarray) -> Camera:
    """Move a camera to world coordinates p_new = to_frame @ p_old, a 4×4 similarity."""
    scale, rotation, translation = split_similarity(to_frame)
    old = camera.world_to_camera
    pose = np.eye(4)
    pose[:3, :3] = old[:3, :3] @ rotation.T
    pose[:3, 3] = scale * old[:3, 3] - pose[:3, :3] @ translation
    return replace(camera, world_to_camera=pose)
