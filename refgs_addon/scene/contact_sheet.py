"""Render a contact sheet: one view under many lights, in one picture."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import bpy

from ..errors import InputError
from ..nodes.panorama_world import RECOVERED, get_light, is_panorama, set_light
from .atomic_file import atomic_write
from .render_eevee import render_preview
from .world_light import correct_diffuse, relight

if TYPE_CHECKING:
    import numpy as np

GAP = 4  # pixels between pictures


def contact_sheet(
    scene: bpy.types.Scene,
    png: Path,
    hdris: Sequence[Path],
    size: int = 256,
    samples: int = 32,
    progress: Callable[[int, str], None] = lambda done, what: None,
) -> None:
    """Render the scene camera's view in Eevee under several lights, and put all pictures into one PNG.

    Each HDRI gives one picture. The light recovered from the photos, if there is one, gives the first picture. The pictures lie in rows on
    a transparent, roughly square sheet. `size` is the longer side of each picture in pixels. `progress` is called with the number of
    finished pictures and the name of the next light. The scene's light is restored. Raises InputError if there is no camera, if there is no
    light, if a light cannot be read, or if the file cannot be written.
    """
    from .pictures import read_png, write_png  # needs numpy, which Debian's Blender may lack

    world = scene.world
    known = is_panorama(world) and world.get(RECOVERED) is not None
    lights: list[Path | None] = ([None] if known else []) + list(hdris)
    if not lights:
        raise InputError("there is no light to render under: choose a folder of HDRIs in the preferences")
    if not png.parent.is_dir():  # Blender would create it
        raise InputError(f"cannot write {png}: its folder does not exist")
    before = get_light(world) if is_panorama(world) else None
    kept = world is not None and world.use_fake_user
    pictures = []
    try:
        with tempfile.TemporaryDirectory() as folder:
            for number, light in enumerate(lights):
                progress(number, light.stem if light else "the recovered light")
                relight(scene, light)
                file = Path(folder) / f"{number}.png"
                render_preview(scene, file, size=size, samples=samples)
                pictures.append(read_png(file))
    finally:
        lit, scene.world = scene.world, world
        if before is not None:
            set_light(world, *before)
            correct_diffuse(scene)
        elif lit != world:
            bpy.data.worlds.remove(lit)
            if world is not None:
                world.use_fake_user = kept
    progress(len(lights), "layout")
    with atomic_write(png) as temporary:
        write_png(temporary, _sheet(pictures))


def _sheet(pictures: "list[np.ndarray]") -> "np.ndarray":
    """Put pictures (H, W, 4) of one size in rows, on a transparent, roughly square sheet."""
    import numpy as np

    height, width = pictures[0].shape[:2]
    columns = max(1, round((len(pictures) * height / width) ** 0.5))
    rows = -(-len(pictures) // columns)
    sheet = np.zeros((rows * (height + GAP) - GAP, columns * (width + GAP) - GAP, 4), np.float32)
    for number, picture in enumerate(pictures):
        row, column = divmod(number, columns)
        top, left = row * (height + GAP), column * (width + GAP)
        sheet[top : top + height, left : left + width] = picture
    return sheet
