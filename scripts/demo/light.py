"""Find and read the HDRIs that come with Blender."""

from pathlib import Path

import numpy as np

from refgs.errors import InputError
from refgs.formats.panorama import read_environment


def studio_lights() -> dict[str, Path]:
    """List Blender's own CC0 panoramas by name: city, courtyard, forest, interior, night, studio, sunrise, sunset."""
    import bpy

    folder = Path(bpy.utils.system_resource("DATAFILES", path="studiolights/world"))
    return {path.stem: path for path in sorted(folder.glob("*.exr"))}


def read_light(name: str) -> np.ndarray:
    """Read one of Blender's panoramas: (height, width, 3) float32 linear radiance, in Blender's orientation."""
    lights = studio_lights()
    if name not in lights:
        raise InputError(f"there is no HDRI {name!r}: choose one of {', '.join(lights)}")
    return read_environment(lights[name])
