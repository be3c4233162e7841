"""Compare two panoramas: find the rotation and the brightness factor between them. Compute a panorama's diffuse light."""

import math

import bpy
import numpy as np

from ..nodes.world_diffuse import BANDS, LOBE, THIRD
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


def diffuse_light(image: bpy.types.Image) -> np.ndarray:
    """Compute a panorama's diffuse light: the irradiance over π, as coefficients of nine spherical harmonics (9, 3).

    They are for `nodes.world_diffuse.set_harmonics`, in Blender's working space, as Eevee's own light is.
    """
    light = _reduced(image)
    height, azimuth = (
        (np.pi * ((np.arange(ROWS) + 0.5) / ROWS - 0.5))[:, None],
        np.pi * (1 - (np.arange(2 * ROWS) + 0.5) / ROWS),
    )
    x, y, z = np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height) + 0 * azimuth
    constants = np.array([BANDS[0], *[BANDS[1]] * 3, *THIRD])
    polynomials = np.stack([x * 0 + 1, x, y, z, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y])
    area = np.cos(height) * (np.pi / ROWS) ** 2
    radiance = np.einsum("khw,hwc->kc", polynomials * area, light) * constants[:, None]
    return radiance * np.repeat(LOBE, [1, 3, 5])[:, None]


def _reduced(image: bpy.types.Image) -> np.ndarray:
    """Resample a panorama to (ROWS, 2·ROWS, 3) in the working space, bottom row first."""
    width, height = image.size
    pixels = np.empty(width * height * image.channels, np.float32)
    image.pixels.foreach_get(pixels)
    rows = _means(height, ROWS) @ pixels.reshape(height, -1)
    light = np.einsum("cw,rwk->rck", _means(width, 2 * ROWS), rows.reshape(ROWS, width, -1), optimize=True)
    return light[..., :3] if image.channels >= 3 else np.repeat(light[..., :1], 3, axis=2)


def _means(pixels: int, cells: int) -> np.ndarray:
    """Return the matrix (cells, pixels) that takes the mean over each of `cells` equal parts of a line of pixels."""
    edges, starts = np.linspace(0, pixels, cells + 1)[:, None], np.arange(pixels)
    overlap = np.minimum(edges[1:], starts + 1) - np.maximum(edges[:-1], starts)
    return (overlap.clip(0) * (cells / pixels)).astype(np.float32)
