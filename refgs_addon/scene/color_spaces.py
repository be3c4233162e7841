"""Choose colour spaces by lists of their possible names, because each OpenColorIO config names them differently."""

import bpy

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
    """Set an image's colour space to the first of `names` that the OpenColorIO config has. If there is none, return False."""
    return _set_first(image.colorspace_settings, "name", names)


def set_srgb_view(scene: bpy.types.Scene) -> None:
    """Show a scene on an sRGB display without tone mapping, look, exposure or gamma correction.

    If the OpenColorIO config has no such display or view, the scene keeps its own.
    """
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
