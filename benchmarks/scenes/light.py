"""HDRIs: those that come with Blender, and reading and writing them."""

from pathlib import Path

import numpy as np
import OpenEXR

from refgs.errors import InputError


def studio_lights() -> dict[str, Path]:
    """Blender's own CC0 panoramas by name: city, courtyard, forest, interior, night, studio, sunrise, sunset."""
    import bpy

    folder = Path(bpy.utils.system_resource("DATAFILES", path="studiolights/world"))
    return {path.stem: path for path in sorted(folder.glob("*.exr"))}


def read_light(name: str) -> np.ndarray:
    """One of Blender's panoramas, (height, width, 3) float32 linear radiance, in Blender's orientation."""
    lights = studio_lights()
    if name not in lights:
        raise InputError(f"there is no HDRI {name!r}: choose one of {', '.join(lights)}")
    return OpenEXR.File(str(lights[name])).channels()["RGB"].pixels.astype(np.float32)


def turn_light(light: np.ndarray, angle: float) -> np.ndarray:
    """The panorama turned about z by `angle` (radians, counter-clockwise seen from above), to the nearest column.

    A direction's column is u = 0.5 − azimuth/2π, so a greater azimuth is further left.
    """
    return np.roll(light, -round(angle / (2 * np.pi) * light.shape[1]), axis=1)


def write_exr(path: Path, pixels: np.ndarray) -> None:
    """(h, w, 4) RGBA, (h, w, 3) RGB or (h, w) Y as a float32 EXR, ZIP, scan lines."""
    pixels = np.ascontiguousarray(pixels, np.float32)
    name = "Y" if pixels.ndim == 2 else "RGBA"[: pixels.shape[2]]
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {name: pixels}).write(str(path))
