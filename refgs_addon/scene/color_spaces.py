"""Choose colour spaces by lists of their possible names, because each OpenColorIO config names them differently.

Blender converts pictures to its working space, which a config, or from Blender 5 the file, may choose. It takes the colours that a script
gives to attributes and nodes as they are. RefGS's are linear Rec.709, so they pass through `from_rec709` and `to_rec709`.
"""

from typing import TYPE_CHECKING

import bpy
from mathutils import Color, Matrix, Vector

if TYPE_CHECKING:
    import numpy as np

# Names of a space in Blender's configs, in those of ACES 1.3 and 2, in those of ACES 1.0 and 1.2, and in others.
SRGB = (
    "sRGB",
    "sRGB - Texture",
    "sRGB Encoded Rec.709 (sRGB)",
    "Utility - sRGB - Texture",
    "Input - Generic - sRGB - Texture",
    "sRGB Texture",
    "srgb_texture",
    "srgb_tx",
    "srgb_rec709_scene",
    "srgb",
)
LINEAR_REC709 = (
    "Linear Rec.709",
    "Linear Rec.709 (sRGB)",
    "Utility - Linear - sRGB",
    "Utility - Linear - Rec.709",
    "Linear BT.709",
    "Linear sRGB",
    "lin_rec709_srgb",
    "lin_rec709_scene",
    "lin_rec709",
    "lin_srgb",
    "Linear",
)
# A display with sRGB's curve, and its view without tone mapping. ACES 1.2 has none: its view sRGB maps tones.
_DISPLAYS = ("sRGB", "sRGB - Display")
_VIEWS = ("Standard", "Un-tone-mapped")


def set_color_space(image: bpy.types.Image, names: tuple[str, ...]) -> bool:
    """Give an image the first of these colour spaces that exists, else return False."""
    return _set_first(image.colorspace_settings, "name", names)


def from_rec709(colors: "np.ndarray | tuple[float, ...]") -> "np.ndarray | tuple[float, ...]":
    """Convert linear Rec.709 colours to Blender's working space.

    `colors` is an array (..., 3) or (..., 4), or a tuple of three or four numbers; so is the result. Alpha stays. If the working space is
    linear Rec.709, `colors` itself is returned.
    """
    return _convert(colors, _working_space())


def to_rec709(colors: "np.ndarray | tuple[float, ...]") -> "np.ndarray | tuple[float, ...]":
    """Convert colours of Blender's working space to linear Rec.709, unclipped."""
    return _convert(colors, _working_space().inverted())


def _convert(colors: "np.ndarray | tuple[float, ...]", matrix: Matrix) -> "np.ndarray | tuple[float, ...]":
    # Blender's own matrix from linear Rec.709 to itself is not quite the identity: up to 1e-5 off in 4.5.
    if max(abs(x) for row in matrix - Matrix.Identity(3) for x in row) < 1e-4:
        return colors
    if isinstance(colors, tuple):
        return (*(matrix @ Vector(colors[:3])), *colors[3:])
    import numpy as np  # Debian's Blender may lack it

    result = colors.copy()
    result[..., :3] = result[..., :3] @ np.array(matrix).T
    return result


def _working_space() -> Matrix:
    """Find the matrix from linear Rec.709 to Blender's working space.

    A picture is converted, because the functions for single colours change nothing with configs of ACES 1.0 to 1.2.
    """
    image = bpy.data.images.new("primaries", 3, 1, float_buffer=True, is_data=True)
    try:
        image.pixels = 1, 0, 0, 1, 0, 1, 0, 1, 0, 0, 1, 1
        image.pack()  # a new colour space then holds for these pixels
        if set_color_space(image, LINEAR_REC709):
            primaries = [image.pixels[start : start + 3] for start in (0, 4, 8)]
        else:
            primaries = [Color(primary).from_rec709_linear_to_scene_linear() for primary in Matrix.Identity(3)]
    finally:
        bpy.data.images.remove(image)
    return Matrix(primaries).transposed()


def set_srgb_view(scene: bpy.types.Scene) -> None:
    """Show a scene on an sRGB display without tone mapping, look, exposure or gamma correction."""
    view = scene.view_settings
    _set_first(scene.display_settings, "display_device", _DISPLAYS)
    _set_first(view, "view_transform", _VIEWS)
    view.look, view.exposure, view.gamma = "None", 0.0, 1.0


def _set_first(settings: bpy.types.bpy_struct, name: str, values: tuple[str, ...]) -> bool:
    for value in values:
        try:
            setattr(settings, name, value)
        except TypeError:  # no such item
            continue
        return True
    return False
