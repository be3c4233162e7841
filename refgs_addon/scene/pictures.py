"""Read and write PNG files with their values as they are stored, without a colour space."""

from pathlib import Path

import bpy
import numpy as np

from ..ordinary import check_file


def read_png(path: Path) -> np.ndarray:
    """Read the stored RGBA values of a picture, 0..1: (height, width, 4) float32, top row first. Raises OSError if it cannot be read."""
    check_file(path)
    image = bpy.data.images.load(str(path))
    try:
        image.colorspace_settings.is_data = True
        image.alpha_mode = "CHANNEL_PACKED"
        width, height = image.size
        if not width:
            raise OSError(None, "it is not a whole picture", str(path))
        pixels = np.empty(4 * width * height, np.float32)
        image.pixels.foreach_get(pixels)
        return pixels.reshape(height, width, 4)[::-1].copy()
    finally:
        bpy.data.images.remove(image)


def write_png(path: Path, pixels: np.ndarray) -> None:
    """Write values 0..1, (height, width, 3) or with alpha (height, width, 4), top row first, as an 8-bit PNG."""
    height, width, channels = pixels.shape
    image = bpy.data.images.new(path.stem, width, height, alpha=channels == 4, is_data=True)
    try:
        image.alpha_mode = "CHANNEL_PACKED"
        image.file_format = "PNG"
        values = np.ones((height, width, 4), np.float32)
        values[..., :channels] = pixels[::-1]
        image.pixels.foreach_set(values.ravel())
        image.save(filepath=str(path))
    finally:
        bpy.data.images.remove(image)
