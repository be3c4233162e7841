"""Contact sheets: one view under many lights, on one picture."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import bpy

from ..errors import InputError
from ..nodes.panorama_world import IMAGE, RECOVERED, ROTATION, STRENGTH, is_panorama
from .atomic_file import whole
from .render_eevee import render_preview
from .world_light import relight

GAP = 4  # pixels between pictures


def contact_sheet(
    scene: bpy.types.Scene,
    png: Path,
    hdris: Sequence[Path],
    size: int = 256,
    samples: int = 32,
    progress: Callable[[int, str], None] = lambda done, what: None,
) -> None:
    """Render the scene camera's view in Eevee under the recovered light, if there is one, and under each HDRI, and lay the pictures on one
    PNG with a transparent ground, row by row, about as wide as high.

    `size` is the longer side of each in pixels. The scene's light is put back. `progress` hears how many are done, and which is next.
    Raises InputError where there is no camera, a light cannot be read, or the file cannot be written.
    """
    import numpy as np

    world = scene.world
    known = is_panorama(world) and world.get(RECOVERED) is not None
    lights: list[Path | None] = ([None] if known else []) + list(hdris)
    if not lights:
        raise InputError("there is no light to show the object under: choose a folder of HDRIs in the preferences")
    if not png.parent.is_dir():  # Blender would make it
        raise InputError(f"cannot write {png}: its folder is not there")
    before = _light(world) if is_panorama(world) else None
    pictures = []
    try:
        with tempfile.TemporaryDirectory() as folder:
            for number, light in enumerate(lights):
                progress(number, light.stem if light else "the recovered light")
                relight(scene, light)
                file = Path(folder) / f"{number}.png"
                render_preview(scene, file, size=size, samples=samples)
                pictures.append(_pixels(file))
    finally:
        lit, scene.world = scene.world, world
        if before is not None:
            nodes = world.node_tree.nodes
            nodes[IMAGE].image = before[0]
            nodes[ROTATION].inputs["Rotation"].default_value = before[1]
            nodes[STRENGTH].inputs["Strength"].default_value = before[2]
        elif lit is not None:
            bpy.data.worlds.remove(lit)
    progress(len(lights), "laying them out")
    height, width = pictures[0].shape[:2]
    columns = max(1, round((len(pictures) * height / width) ** 0.5))
    rows = -(-len(pictures) // columns)
    sheet = np.zeros((rows * (height + GAP) - GAP, columns * (width + GAP) - GAP, 4), np.float32)
    for number, picture in enumerate(pictures):
        row, column = divmod(number, columns)
        top, left = row * (height + GAP), column * (width + GAP)
        sheet[top : top + height, left : left + width] = picture
    _write(sheet, png)


def _light(world: bpy.types.World) -> tuple:
    """What is to be put back: the image, the rotation, the strength."""
    nodes = world.node_tree.nodes
    rotation = nodes[ROTATION].inputs["Rotation"].default_value
    return nodes[IMAGE].image, tuple(rotation), nodes[STRENGTH].inputs["Strength"].default_value


def _pixels(file: Path):
    """A PNG's numbers (h, w, 4) as they are in the file, the top row first."""
    import numpy as np

    image = bpy.data.images.load(str(file))
    image.colorspace_settings.name = "Non-Color"
    image.alpha_mode = "CHANNEL_PACKED"
    pixels = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(pixels)
    pixels = pixels.reshape(image.size[1], image.size[0], 4)[::-1].copy()
    bpy.data.images.remove(image)
    return pixels


def _write(pixels, png: Path) -> None:
    import numpy as np

    height, width = pixels.shape[:2]
    image = bpy.data.images.new(png.stem, width, height, alpha=True)
    image.alpha_mode = "CHANNEL_PACKED"
    image.colorspace_settings.name = "Non-Color"
    image.file_format = "PNG"
    try:
        image.pixels.foreach_set(np.ascontiguousarray(pixels[::-1]).ravel())
        with whole(png) as temporary:
            image.save(filepath=str(temporary))
    finally:
        bpy.data.images.remove(image)
