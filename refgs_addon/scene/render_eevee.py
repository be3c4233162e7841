"""Render a view in Eevee, independently of the scene's own render settings."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import bpy

from .. import compat
from ..errors import InputError
from .atomic_file import atomic_write
from .camera_objects import frame_camera
from .color_spaces import set_srgb_view

if bpy.app.background:
    # Mesa's software renderer reads far-off texels when it filters anisotropically: pixels of wrong colours, on flat parts, too. Mesa reads
    # this variable before the first picture. Blender's preference does not reach its renders in 5.2.
    os.environ.setdefault(
        "MESA_EXTENSION_OVERRIDE", "-GL_EXT_texture_filter_anisotropic -GL_ARB_texture_filter_anisotropic"
    )


def render_preview(
    scene: bpy.types.Scene,
    png: Path,
    camera: bpy.types.Object | None = None,
    size: int | None = None,
    samples: int = 64,
    exr: Path | None = None,
    engine: str = compat.EEVEE,
) -> None:
    """Render a camera's view over a transparent background, in Eevee or the render engine `engine`. The default camera is the scene's.

    `size` is the picture's longer side in pixels; by default the picture is as large as the camera's photo. `samples` is the number of
    samples in Eevee.
    - `png` gets 8-bit sRGB with straight alpha, through the Standard view transform. If the OpenColorIO config has no Standard view, the
      scene's own view is used.
    - `exr` gets radiance in 32 bits, premultiplied, in the space that Blender gives float pictures: by default linear Rec.709.

    The scene's own settings are restored. Raises InputError if there is no camera or a file cannot be written.
    """
    camera = camera or scene.camera
    if camera is None:
        raise InputError("there is no camera to look through: add one, or import a RefGS run with cameras.json")
    with _restored(scene):
        frame_camera(scene, camera, size)
        render = scene.render
        render.engine = engine
        render.film_transparent = True
        render.use_compositing = render.use_sequencer = False
        scene.eevee.taa_render_samples = samples
        set_srgb_view(scene)
        bpy.ops.render.render(scene=scene.name)
        picture = bpy.data.images["Render Result"]
        _save(picture, scene, png, "PNG", "8")
        if exr is not None:
            _save(picture, scene, exr, "OPEN_EXR", "32")


def _save(picture: bpy.types.Image, scene: bpy.types.Scene, path: Path, kind: str, depth: str) -> None:
    compat.set_format(scene.render.image_settings, kind, depth)
    with atomic_write(path) as temporary:
        picture.save_render(str(temporary), scene=scene)


@contextlib.contextmanager
def _restored(scene: bpy.types.Scene) -> Iterator[None]:
    """Restore all render settings that a preview changes, at the end of the `with` block."""
    render = scene.render
    touched = [
        (scene, ["camera"]),
        (render, ["engine", "film_transparent", "use_compositing", "use_sequencer", "resolution_x", "resolution_y"]),
        (render, ["resolution_percentage", "pixel_aspect_x", "pixel_aspect_y"]),
        (scene.eevee, ["taa_render_samples"]),
        (scene.display_settings, ["display_device"]),
        (scene.view_settings, ["view_transform", "look", "exposure", "gamma"]),
        (render.image_settings, compat.FORMAT),
    ]
    values = [(owner, name, getattr(owner, name)) for owner, names in touched for name in names]
    try:
        yield
    finally:
        for owner, name, value in values:
            setattr(owner, name, value)
