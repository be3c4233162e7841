"""Make icons for the panels: thumbnails of files, and balls of materials.

Blender's layouts name an icon by its number, the argument `icon_value`.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import bpy
import bpy.utils.previews

if TYPE_CHECKING:
    import numpy as np

BALL = 32  # pixels, Blender's size of icons

_pictures: bpy.utils.previews.ImagePreviewCollection | None = None


def thumbnail(file: Path, version: int = 0) -> int:
    """Return the number of the icon with a file's thumbnail, or 0 in a Blender without a window.

    Blender makes the thumbnail in the background. If the file was overwritten, pass another `version` to load it again.
    """
    if _pictures is None:
        return 0
    key = f"{file} {version}"
    return (_pictures[key] if key in _pictures else _pictures.load(key, str(file), "IMAGE")).icon_id


def swatch(file: Path, values: dict) -> int:
    """Return the number of an icon with a ball of a material preset, 0 if Blender has no window or no numpy.

    `values` are those of the preset in `file`, as `material_presets.read_material` returns them.
    """
    if _pictures is None:
        return 0
    key = f"{file} {values}"
    if key not in _pictures:
        color = values.get("Base Color", (0.5, 0.5, 0.5))[:3]
        try:
            pixels = ball(color, values.get("Metallic", 0.0), values.get("Roughness", 0.5))
        except ModuleNotFoundError:
            return 0
        shown = _pictures.new(key)
        shown.icon_size = BALL, BALL
        shown.icon_pixels_float = pixels.ravel().tolist()
    return _pictures[key].icon_id


def ball(color: tuple[float, ...], metallic: float, roughness: float) -> "np.ndarray":
    """Draw a ball of a material, lit from the upper left. Returns sRGB pixels, premultiplied with alpha (BALL, BALL, 4), bottom row first.

    `color` is linear Rec.709. A metal has a darker rim, and highlights in its colour.
    """
    import numpy as np

    y, x = np.mgrid[-1 : 1 : BALL * 1j, -1 : 1 : BALL * 1j]
    z = np.sqrt((1 - x**2 - y**2).clip(0))
    base, normal = np.array(color), np.stack([x, y, z], axis=-1)
    light, half = np.array([-0.5, 0.6, 0.62]), np.array([-0.28, 0.34, 0.9])
    diffuse = (0.2 + 0.8 * (normal @ light).clip(0)) * (1 - 0.7 * metallic * (1 - z))
    shine = (normal @ half).clip(0) ** (2 / max(roughness, 0.2) ** 4)  # Blinn's exponent for a GGX roughness
    tint = metallic * base + (1 - metallic) * 0.5
    linear = (base * diffuse[..., None] + tint * ((1 - 0.7 * roughness) * shine)[..., None]).clip(0, 1)
    inside = x**2 + y**2 <= 1
    return np.dstack([linear ** (1 / 2.2) * inside[..., None], inside]).astype(np.float32)


def register() -> None:
    global _pictures
    _pictures = bpy.utils.previews.new()


def unregister() -> None:
    global _pictures
    bpy.utils.previews.remove(_pictures)
    _pictures = None
