"""Compare two panoramas: find the rotation and the brightness factor between them."""

import math

import bpy
import numpy as np

ROWS = 64  # of the downsampled panoramas that are compared
FAINT = 0.01  # of the mean radiance: floor of the logarithm
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # Rec.709


def best_rotation(image: bpy.types.Image, other: bpy.types.Image) -> tuple[float, float]:
    """Find the rotation about z and the brightness factor that make the panorama `image` most like `other`. Both are equirectangular.

    The rotation is in radians, -π..π, counter-clockwise seen from above. It maximises the correlation of the log luminances, weighted by
    solid angle. The factor is the mean luminance of `other` over the sphere, divided by that of `image`.
    """
    area = np.cos(np.pi * ((np.arange(ROWS) + 0.5) / ROWS - 0.5))[:, None]
    small = [_luminance(picture) for picture in (image, other)]
    means = [float((values * area).sum() / area.sum() / values.shape[1]) for values in small]
    seen = [np.log(values / max(mean, 1e-12) + FAINT) for values, mean in zip(small, means, strict=True)]
    # Columns run against the azimuth: after a rotation by a, column c shows what was at c + a W / 2π.
    turned, still = (np.fft.rfft(values - (values * area).mean() / area.mean()) for values in seen)
    correlation = np.fft.irfft((turned * still.conj() * area).sum(axis=0), 2 * ROWS)
    best = int(correlation.argmax())
    before, peak, after = correlation[best - 1], correlation[best], correlation[(best + 1) % (2 * ROWS)]
    bend = before - 2 * peak + after
    place = best + (0.5 * (before - after) / bend if bend < 0 else 0.0)  # between columns: vertex of the parabola
    turn = 2 * math.pi * place / (2 * ROWS)
    return (turn + math.pi) % (2 * math.pi) - math.pi, means[1] / max(means[0], 1e-12)


def _luminance(image: bpy.types.Image) -> np.ndarray:
    """Compute a panorama's luminance, resampled to (ROWS, 2 · ROWS) pixels by area averaging. The bottom row comes first."""
    width, height = image.size
    pixels = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(pixels)
    pixels = pixels.reshape(height, width, image.channels)
    light = pixels[..., :3] @ LUMINANCE if image.channels >= 3 else pixels[..., 0]
    for axis, size in ((0, ROWS), (1, 2 * ROWS)):
        # Interpolated cumulative sums give the mean over each cell, for any ratio of the sizes.
        sums = np.concatenate([np.zeros_like(light.take([0], axis)), light.cumsum(axis, dtype=np.float64)], axis)
        edges = np.linspace(0, light.shape[axis], size + 1)
        below = np.minimum(edges.astype(int), light.shape[axis] - 1)
        part = (edges - below).reshape((-1, 1) if axis == 0 else (1, -1))
        at = (1 - part) * sums.take(below, axis) + part * sums.take(below + 1, axis)
        light = np.diff(at, axis=axis) * (size / light.shape[axis])
    return light
