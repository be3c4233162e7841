"""Project world points into a camera's image and back along rays, and interpolate the image at pixel positions."""

import cv2
import numpy as np

from refgs.camera import Camera

_ROW = 4096  # points a row: cv2.remap takes pictures, not lists


def project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project world points (N, 3). Returns float32 pixel positions (N, 2), and depths along the camera's axis (N,).

    Pixel positions of points with depth ≤ 0 are meaningless.
    """
    matrix = camera.projection.astype(np.float32)
    x, y, z = matrix[:, :3] @ np.asarray(points, np.float32).T + matrix[:, 3:]
    inverse = 1 / np.where(np.abs(z) > 1e-12, z, np.float32(1e-12))
    return np.stack([x * inverse, y * inverse], axis=1), z


def pixel_rays(camera: Camera, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return rays (N, 3) through N pixels, in the world's axes. Each ray's component along the camera's axis is 1.

    `rows` and `columns` (N,) are indices of pixels. An integer means the centre of a pixel; fractions are allowed.
    """
    x, y = (columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy
    return np.stack([x, y, np.ones(len(x))]).T @ camera.world_to_camera[:3, :3]


def sample(image: np.ndarray, pixels: np.ndarray, clamp: bool = False) -> np.ndarray:
    """Interpolate a float32 image (H, W) or (H, W, C) at pixel positions (N, 2), bilinearly. Returns (N,) or (N, C).

    The centre of the first pixel is at (0.5, 0.5). Outside the image the result is 0. If `clamp` is true, it is the nearest pixel's value
    instead. Positions are rounded to 1/32 of a pixel, because OpenCV's `remap` does the work.
    """
    count = len(pixels)
    rows = max(1, -(-count // _ROW))
    maps = np.full((rows * _ROW, 2), -10, np.float32)
    np.clip(pixels - np.float32(0.5), -10, 32000, out=maps[:count])
    maps = maps.reshape(rows, _ROW, 2)
    border = cv2.BORDER_REPLICATE if clamp else cv2.BORDER_CONSTANT
    values = remap(image, maps, border=border)
    return values.reshape(rows * _ROW, *image.shape[2:])[:count]


def remap(
    image: np.ndarray,
    at: np.ndarray,
    interpolation: int = cv2.INTER_LINEAR,
    border: int = cv2.BORDER_CONSTANT,
    outside: float = 0.0,
) -> np.ndarray:
    """Interpolate an image at the positions `at` (H, W, 2), by OpenCV's `remap`. Returns (H, W) or (H, W, C).

    A position is a column and a row, float32. The centre of the first pixel is at (0, 0). Outside the image, the first channel is
    `outside`, and other channels are 0.
    """
    one_map = np.empty(0, np.float32)  # in place of a second map: `at` has both coordinates
    return cv2.remap(image, at, one_map, interpolation, borderMode=border, borderValue=(outside,))


def inside(camera: Camera, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Test which results of `project` are in front of the camera and inside its image."""
    x, y = pixels[:, 0], pixels[:, 1]
    return (depth > 0) & (x >= 0) & (x <= camera.width) & (y >= 0) & (y <= camera.height)
