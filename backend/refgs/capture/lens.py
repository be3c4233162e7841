"""Undistort photos by the lens models of OpenCV, COLMAP and nerfstudio.

A lens model maps (x, y) = (X/Z, Y/Z) to the distorted (x', y'), and the pixel is (fx·x' + cx, fy·y' + cy). Brown's model is computed here,
because no model of COLMAP has its k4: with r² = x² + y²,
    x' = x·(1 + k1·r² + k2·r⁴ + k3·r⁶ + k4·r⁸) + 2·p1·x·y + p2·(r² + 2x²)
    y' = y·(1 + k1·r² + k2·r⁴ + k3·r⁶ + k4·r⁸) + p1·(r² + 2y²) + 2·p2·x·y
All other models are COLMAP's, and pycolmap computes them.

The undistorted photo has the same size in pixels. Its focal length is chosen so that it shows as much as possible of the distorted photo
without black borders. A thin strip at the edges of the distorted photo is lost. With a fisheye lens, more is lost.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from refgs.camera import Camera
from refgs.errors import InputError

ALL = slice(None)
BROWN = "BROWN"
WIDEST = 0.5  # least part of the focal length that is left: a fisheye photo's centre keeps half of its resolution
SHORTEST, LONGEST = 1e-2, 1e6  # focal lengths, in sides of the photo
OUTSIDE = 1e2  # largest coordinate of the principal point, in sides of the photo
BEHIND = 1e3  # image position, at depth 1, of what a pinhole camera cannot see. Masks are continued there


@dataclass(frozen=True)
class Lens:
    """Hold the lens of a photo: its intrinsics, the name of its model, and the model's coefficients.

    Focal lengths and principal point are in pixels; pixel centres are at half-integers. The model BROWN has the coefficients k1, k2, k3,
    k4, p1, p2. Any other model is COLMAP's. Its coefficients are those that COLMAP lists after the principal point. `turns` is the
    number of clockwise quarter turns that the photo got after the coefficients were measured.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    model: str
    coefficients: tuple[float, ...]
    turns: int = 0

    @property
    def distorts(self) -> bool:
        """Tell whether the lens differs from a pinhole, as every fisheye lens does."""
        return any(self.coefficients) or any(map(np.any, np.subtract(self.distort(0.5, 0.25), (0.5, 0.25))))

    def distort(self, x: Any, y: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the distorted image position (x', y') of an undistorted one (x, y). Both are on the image plane at depth 1.

        The result is NaN where the model does not define a distorted position.
        """
        x, y = np.broadcast_arrays(x, y)
        for _ in range(self.turns):
            x, y = y, -x
        x, y = _brown(self.coefficients, x, y) if self.model == BROWN else self._project(x, y)
        for _ in range(self.turns):
            x, y = -y, x
        return x, y

    def _project(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3).astype(np.float64)
        u, v = _colmap_camera(self.model, self.coefficients).img_from_cam(rays).T
        return u.reshape(x.shape), v.reshape(x.shape)

    def undistort(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the undistorted image position of a distorted one: the inverse of `distort`. Both are on the image plane at depth 1.

        A pinhole camera cannot see points at 90° from its axis or more. For such points the result is far from the image's centre, in the
        direction of the distorted position.
        """
        x_seen, y_seen = np.broadcast_arrays(x, y)
        if self.model == BROWN:
            x, y = x_seen, y_seen
            for _ in range(10):  # fixed point: converges, because photos are only read through lenses that do not fold
                x_now, y_now = self.distort(x, y)
                x, y = x + x_seen - x_now, y + y_seen - y_now
            return x, y
        for _ in range(self.turns):
            x, y = y, -x
        seen = np.stack(np.broadcast_arrays(x, y), axis=-1)
        x, y = _colmap_camera(self.model, self.coefficients).cam_from_img(seen.reshape(-1, 2)).reshape(seen.shape).T
        x, y = x.T, y.T
        for _ in range(self.turns):
            x, y = -y, x
        # COLMAP returns other pixels as they are.
        x_again, y_again = self.distort(x, y)
        found = np.hypot(x_again - x_seen, y_again - y_seen) < 1e-6
        return np.where(found, x, BEHIND * x_seen), np.where(found, y, BEHIND * y_seen)

    def turned(self, height: int) -> "Lens":
        """Return the lens for its photo, `height` pixels high, turned clockwise by 90°."""
        return replace(self, fx=self.fy, fy=self.fx, cx=height - self.cy, cy=self.cx, turns=(self.turns + 1) % 4)

    def pinhole(self, camera: Camera, where: str) -> Camera:
        """Return the pinhole camera of the undistorted photo. It has the pose and the size of `camera`.

        Raises InputError if the distortion is too strong. The message begins with `where`, a name for the camera.
        """
        factor = _focal_factor(self, camera.width, camera.height)
        if factor is None:
            raise InputError(
                f"{where}: the distortion is too strong for a perspective photo ({self.model}). Undistort it first."
            )
        return replace(camera, fx=self.fx * factor, fy=self.fy * factor, cx=self.cx, cy=self.cy)

    def maps(self, camera: Camera, rows: slice = ALL) -> tuple[np.ndarray, np.ndarray]:
        """Return the maps that `cv2.remap` needs to undistort the photo: columns and rows, each (R, W) float32.

        For each pixel in these `rows` of the undistorted photo (of the pinhole `camera`), they hold its position in the distorted photo.
        """
        x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        y = (np.arange(camera.height)[rows] + 0.5 - camera.cy) / camera.fy
        x, y = self.distort(x[None, :], y[:, None])
        # The first pixel's centre is at 0 in OpenCV, at 0.5 in a Camera.
        return (self.fx * x + self.cx - 0.5).astype(np.float32), (self.fy * y + self.cy - 0.5).astype(np.float32)

    def maps_back(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Return the maps that `cv2.remap` needs to distort a picture of the pinhole `camera`: columns and rows, each (H, W) float32.

        For each pixel of the distorted picture, they hold its position in the undistorted picture.
        """
        x_seen = ((np.arange(camera.width) + 0.5 - self.cx) / self.fx)[None, :]
        y_seen = ((np.arange(camera.height) + 0.5 - self.cy) / self.fy)[:, None]
        x, y = self.undistort(x_seen, y_seen)
        columns, rows = camera.fx * x + camera.cx - 0.5, camera.fy * y + camera.cy - 0.5
        return columns.astype(np.float32), rows.astype(np.float32)

    def resized(self, x: float, y: float) -> "Lens":
        """Return the lens for its photo scaled by the factors `x` and `y`."""
        return replace(self, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)


def check_intrinsics(
    size: tuple[float, float], focal: tuple[float, float], centre: tuple[float, float], where: str, advice: str
) -> None:
    """Check the size, focal lengths and principal point of a photo. Each is a pair (horizontal, vertical) in pixels.

    Raises InputError if a value is not finite, or if no real lens has such a value. The message begins with `where`, a name for the
    camera, and ends with `advice`.
    """
    if not np.isfinite([*size, *focal, *centre]).all() or min(focal) <= 0 or round(min(size)) < 1:
        raise InputError(f"{where}: focal length or size is zero, negative or NaN. {advice}")
    for pixels, length in zip(size, focal, strict=True):
        if not SHORTEST * pixels <= length <= LONGEST * pixels:
            raise InputError(
                f"{where}: a focal length of {length:g} pixels is that of no lens, for a side of {pixels:g}. {advice}"
            )
    if max(abs(centre[0]) / size[0], abs(centre[1]) / size[1]) > OUTSIDE:
        at, side = " ".join(f"{x:g}" for x in centre), "×".join(f"{x:g}" for x in size)
        raise InputError(f"{where}: the principal point ({at}) is far outside of the photo's {side} pixels. {advice}")


def _brown(coefficients: tuple[float, ...], x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    k1, k2, k3, k4, p1, p2 = coefficients
    r2 = x * x + y * y
    factor = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    xy = 2 * x * y
    return (
        x * factor + p1 * xy + p2 * (r2 + 2 * x * x),
        y * factor + p1 * (r2 + 2 * y * y) + p2 * xy,
    )


@lru_cache(maxsize=64)
def _colmap_camera(model: str, coefficients: tuple[float, ...]) -> Any:
    """Make pycolmap's camera of focal length 1 and principal point 0."""
    import pycolmap  # slow to import, and few captures need it

    camera = pycolmap.Camera.create_from_model_name(0, model, 1.0, 0, 0)
    camera.params = [1.0] * len(camera.focal_length_idxs()) + [0.0, 0.0, *coefficients]
    return camera


@lru_cache(maxsize=64)
def _focal_factor(lens: Lens, width: int, height: int) -> float | None:
    """Return the least focal-length factor, from WIDEST to 2, without black borders, or None."""
    # A larger factor zooms in. Below WIDEST, the centre of a fisheye photo would lose too much resolution.
    u, v = np.meshgrid(np.linspace(0, width, 65), np.linspace(0, height, 65))

    @np.errstate(over="ignore", invalid="ignore")
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
    return max(high, WIDEST)
