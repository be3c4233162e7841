"""Undistort photos by Brown's radial and tangential lens model, as in OpenCV, COLMAP and nerfstudio.

With (x, y) = (X/Z, Y/Z) and r² = x² + y²,
    x' = x·(1 + k1·r² + k2·r⁴ + k3·r⁶ + k4·r⁸) + 2·p1·x·y + p2·(r² + 2x²)
    y' = y·(1 + k1·r² + k2·r⁴ + k3·r⁶ + k4·r⁸) + p1·(r² + 2y²) + 2·p2·x·y
and the pixel is (fx·x' + cx, fy·y' + cy).

The undistorted photo has the same size in pixels. Its focal length is chosen so that it shows as much as possible of the distorted photo
without black borders. A thin strip at the edges of the distorted photo is lost.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from refgs.camera import Camera
from refgs.errors import InputError

ALL = slice(None)


@dataclass(frozen=True)
class Lens:
    """Hold the intrinsics and distortion coefficients of a photo: `radial` is k1..k4, `tangential` is p1, p2.

    Focal lengths and principal point are in pixels; pixel centres are at half-integers.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    radial: tuple[float, float, float, float]
    tangential: tuple[float, float]

    def distort(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the distorted image position (x', y') of an undistorted one (x, y). Both are on the image plane at depth 1."""
        k1, k2, k3, k4 = self.radial
        p1, p2 = self.tangential
        r2 = x * x + y * y
        factor = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        xy = 2 * x * y
        return (
            x * factor + p1 * xy + p2 * (r2 + 2 * x * x),
            y * factor + p1 * (r2 + 2 * y * y) + p2 * xy,
        )

    def turned(self, height: int) -> "Lens":
        """Return the lens for its photo turned clockwise by a quarter turn. `height` is the photo's height before, in pixels."""
        p1, p2 = self.tangential
        return Lens(self.fy, self.fx, height - self.cy, self.cx, self.radial, (p2, -p1))

    def pinhole(self, camera: Camera, where: str) -> Camera:
        """Return the pinhole camera of the undistorted photo. It has the pose and the size of `camera`.

        Raises InputError if the distortion is too strong. The message begins with `where`, a name for the camera.
        """
        factor = _focal_factor(self, camera.width, camera.height)
        if factor is None:
            raise InputError(f"{where}: the distortion is too strong for a perspective photo. Undistort it first.")
        return replace(camera, fx=self.fx * factor, fy=self.fy * factor, cx=self.cx, cy=self.cy)

    def maps(self, camera: Camera, rows: slice = ALL) -> tuple[np.ndarray, np.ndarray]:
        """Return the maps that `cv2.remap` needs to undistort the photo: columns and rows, each (R, W) float32.

        They say, for each pixel in these `rows` of the pinhole `camera`, where it lies in the distorted photo.
        """
        x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        y = (np.arange(camera.height)[rows] + 0.5 - camera.cy) / camera.fy
        x, y = self.distort(x[None, :], y[:, None])
        # The first pixel's centre is at 0 in OpenCV, at 0.5 in a Camera.
        return (self.fx * x + self.cx - 0.5).astype(np.float32), (self.fy * y + self.cy - 0.5).astype(np.float32)

    def maps_back(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Return the maps that `cv2.remap` needs to distort a picture of the pinhole `camera`: columns and rows, each (H, W) float32.

        They say, for each pixel of the distorted photo, where it lies in the undistorted one.
        """
        x_seen = ((np.arange(camera.width) + 0.5 - self.cx) / self.fx)[None, :]
        y_seen = ((np.arange(camera.height) + 0.5 - self.cy) / self.fy)[:, None]
        x, y = np.broadcast_arrays(x_seen, y_seen)
        for _ in range(10):  # fixed point: converges, because photos are only read through lenses that do not fold
            x_now, y_now = self.distort(x, y)
            x, y = x + x_seen - x_now, y + y_seen - y_now
        columns, rows = camera.fx * x + camera.cx - 0.5, camera.fy * y + camera.cy - 0.5
        return columns.astype(np.float32), rows.astype(np.float32)

    def resized(self, x: float, y: float) -> "Lens":
        """Return the lens for its photo made `x` times as wide and `y` times as high."""
        return replace(self, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)


@lru_cache(maxsize=64)
def _focal_factor(lens: Lens, width: int, height: int) -> float | None:
    """Find the smallest factor for the focal lengths with which the undistorted photo has no black borders.

    A larger factor zooms in, so that every pixel lies inside the distorted photo. Return None if the factor would be above 2.
    """
    u, v = np.meshgrid(np.linspace(0, width, 65), np.linspace(0, height, 65))

    def fits(factor: float) -> bool:
        x, y = lens.distort((u - lens.cx) / (lens.fx * factor), (v - lens.cy) / (lens.fy * factor))
        u2, v2 = lens.fx * x + lens.cx, lens.fy * y + lens.cy
        inside = (u2 >= 0) & (u2 <= width) & (v2 >= 0) & (v2 <= height)
        # Far from the axis the polynomial may fold back into the picture: the map must keep its orientation.
        (du_v, du_u), (dv_v, dv_u) = np.gradient(u2), np.gradient(v2)
        return bool(inside.all() and (du_u * dv_v - du_v * dv_u > 0).all())

    low, high = 0.25, 1.0
    while not fits(high):
        low, high = high, high * 1.1
        if high > 2:  # would lose more than half of the photo's width
            return None
    for _ in range(20):  # bisection: the sampled region shrinks as the factor grows, so `fits` changes once
        middle = (low + high) / 2
        low, high = (low, middle) if fits(middle) else (middle, high)
    return high
