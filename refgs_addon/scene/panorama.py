"""Compare two panoramas: find the rotation and the brightness factor between them. Compute a panorama's diffuse light."""

import math
from collections.abc import Sequence

import bpy
import numpy as np
from mathutils import Euler

from .. import compat
from ..nodes.world_diffuse import BANDS, THIRD
from .color_spaces import to_rec709

ROWS = 64  # of the downsampled panoramas that are compared
FAINT = 0.01  # of the mean radiance: floor of the logarithm
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # Rec.709


def best_rotation(image: bpy.types.Image, other: bpy.types.Image) -> tuple[float, float]:
    """Find the rotation about z and the brightness factor that make the panorama `image` most like `other`. Both are equirectangular.

    The rotation is in radians, -π..π, counter-clockwise seen from above. It maximises the correlation of the log luminances, weighted by
    solid angle. The factor is the mean luminance of `other` over the sphere, divided by that of `image`.
    """
    area = np.cos(np.pi * ((np.arange(ROWS) + 0.5) / ROWS - 0.5))[:, None]
    small = [to_rec709(_reduced(picture)) @ LUMINANCE for picture in (image, other)]
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


def diffuse_light(image: bpy.types.Image, rotation: Sequence[float]) -> tuple[np.ndarray, float]:
    """Compute a panorama's diffuse light, and the factor by which Eevee weakens the panorama's harmonics of degree 1.

    The diffuse light is the irradiance over π, as coefficients of nine spherical harmonics (9, 3), for `nodes.world_diffuse.set_harmonics`.
    It is in Blender's working space, as Eevee's own light is. `rotation` rotates the environment: Euler angles in radians.

    For diffuse light, Eevee uses only the harmonics of degree 0 and 1. It multiplies the coefficients of degree 1 by the factor. The factor
    is 1 if they are within a limit. Otherwise it is the largest one that brings red, green and blue within the limit. Let c be the
    coefficient of degree 0 of the radiance in one of these colours, and v the vector of the three coefficients of degree 1.
    - Until Blender 5.0, no component of v may exceed c / √3.
    - From 5.1 on, the length of v may not exceed 0.75 · c.

    On spheres in 4.3, 4.5, 5.0, 5.1, 5.2 and 5.3, under five panoramas each, the computed factor was right to 0.02.
    """
    light = _reduced(image)
    height, azimuth = (
        (np.pi * ((np.arange(ROWS) + 0.5) / ROWS - 0.5))[:, None],
        np.pi * (1 - (np.arange(2 * ROWS) + 0.5) / ROWS),
    )
    x, y, z = np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height) + 0 * azimuth
    x, y, z = np.einsum("ab,bhw->ahw", np.array(Euler(rotation).to_matrix()), np.stack([x, y, z]))
    constants = np.array([BANDS[0], *[BANDS[1]] * 3, *THIRD])
    polynomials = np.stack([x * 0 + 1, x, y, z, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y])
    area = np.cos(height) * (np.pi / ROWS) ** 2
    radiance = np.einsum("khw,hwc->kc", polynomials * area, light) * constants[:, None]
    if compat.EEVEE_WINDOW_BY_LENGTH:
        allowed, needed = 0.75 * radiance[0], np.linalg.norm(radiance[1:4], axis=0)
    else:
        allowed, needed = BANDS[0] / BANDS[1] * radiance[0], np.abs(radiance[1:4]).max(axis=0)
    window = min(1.0, float((allowed / np.maximum(needed, 1e-12)).min()))
    # The cosine lobe's own harmonics, over π: 1, 2/3 and 1/4 by band.
    return radiance * np.repeat([1, 2 / 3, 1 / 4], [1, 3, 5])[:, None], window


def _reduced(image: bpy.types.Image) -> np.ndarray:
    """Resample a panorama to (ROWS, 2·ROWS, 3) in the working space, bottom row first."""
    width, height = image.size
    pixels = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(pixels)
    pixels = pixels.reshape(height, width, image.channels)
    light = pixels[..., :3] if image.channels >= 3 else np.repeat(pixels[..., :1], 3, axis=2)
    for axis, size in ((0, ROWS), (1, 2 * ROWS)):
        # Interpolated cumulative sums give the mean over each cell, for any ratio of the sizes.
        sums = np.concatenate([np.zeros_like(light.take([0], axis)), light.cumsum(axis, dtype=np.float64)], axis)
        edges = np.linspace(0, light.shape[axis], size + 1)
        below = np.minimum(edges.astype(int), light.shape[axis] - 1)
        part = (edges - below).reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
        at = (1 - part) * sums.take(below, axis) + part * sums.take(below + 1, axis)
        light = np.diff(at, axis=axis) * (size / light.shape[axis])
    return light
