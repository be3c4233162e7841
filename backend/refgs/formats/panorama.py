"""Read and sample equirectangular panoramas of radiance, in Blender's orientation (see `directions`)."""

import os
import re
import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np

from refgs.errors import InputError, InputWarning
from refgs.formats.exr import read_exr
from refgs.formats.pixels import check_pixels, decode
from refgs.paths import open_file

HEADER = 1 << 16  # bytes of a Radiance picture in which its size is looked for
# A larger one than a panorama of 8192×4096, with so many pixels a byte, is taken for a broken one. A pixel takes 24 bytes of memory.
_FEWEST = 40_000_000, 4


def read_environment(path: str | os.PathLike) -> np.ndarray:
    """Read a panorama of linear radiance, EXR or Radiance (.hdr), as float32 (H, W, 3). Raises InputError if the file is no panorama.

    Infinite pixels (a sun that overflowed half floats) become the largest half float. Negative radiance becomes 0. NaN becomes 0 too, with
    an InputWarning.
    """
    pixels = _read_radiance(Path(path)) if Path(path).suffix.lower() == ".hdr" else read_exr(path)
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=2)
    height, width = pixels.shape[:2]
    if width != 2 * height:
        raise InputError(f"{path} is {width}×{height}: an equirectangular panorama is twice as wide as it is high")
    radiance = np.ascontiguousarray(pixels[..., :3])
    if missing := int(np.isnan(radiance).any(axis=-1).sum()):
        warnings.warn(InputWarning(f"{path}: {missing:,} pixels are not a number and give no light"), stacklevel=2)
    np.nan_to_num(radiance, copy=False, nan=0, posinf=65504, neginf=0)
    return np.maximum(radiance, 0, out=radiance)


def _read_radiance(path: Path) -> np.ndarray:
    import cv2  # here, because most lights are EXR

    if not path.is_file():
        raise InputError(f"{path} is missing")
    pixels = None
    with suppress(OSError), open_file(path) as file:
        # The size is in the header's last line.
        if size := re.search(rb"\n[-+]Y +(\d{1,9}) +[-+]X +(\d{1,9})\n", file.read(HEADER)):
            width, height = int(size[2]), int(size[1])
            check_pixels(path, width, height, *_FEWEST)
            pixels = decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH, width, height)
    if pixels is None or pixels.dtype != np.float32:
        raise InputError(f"{path}: this is not a Radiance picture that can be read. Download it again.")
    return pixels[..., ::-1]


def directions(height: int, width: int) -> np.ndarray:
    """Compute the unit direction of each pixel of a panorama: float32 (height, width, 3), Z up. The first row is the top.

    As in Blender, the direction (x, y, z) is at u = 0.5 − atan2(y, x)/2π from the left and v = asin(z)/π + 0.5 from the bottom.
    """
    azimuth = 2 * np.pi * (0.5 - (np.arange(width) + 0.5) / width)
    elevation = np.pi * (0.5 - (np.arange(height) + 0.5) / height)[:, None]
    x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
    return np.stack([x, y, np.broadcast_to(np.sin(elevation), x.shape)], axis=-1).astype(np.float32)


def sample(panorama: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Look up a panorama (H, W, C) bilinearly in directions (..., 3) of any length."""
    height, width = panorama.shape[:2]
    x, y, z = np.moveaxis(np.asarray(directions, np.float32), -1, 0)
    column = (0.5 - np.arctan2(y, x) / (2 * np.pi)) * width - 0.5
    row = np.clip((0.5 - np.arctan2(z, np.hypot(x, y)) / np.pi) * height - 0.5, 0, height - 1)
    left = np.floor(column).astype(int)
    top = np.minimum(np.floor(row).astype(int), max(height - 2, 0))
    bottom = np.minimum(top + 1, height - 1)
    s, t = (column - left)[..., None], (row - top)[..., None]
    left, right = left % width, (left + 1) % width
    above = panorama[top, left] * (1 - s) + panorama[top, right] * s
    below = panorama[bottom, left] * (1 - s) + panorama[bottom, right] * s
    return (above * (1 - t) + below * t).astype(np.float32)
