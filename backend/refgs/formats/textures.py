"""Texture maps of a mesh, as PNG and EXR."""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from refgs.color import srgb_encode
from refgs.formats.exr import write_exr
from refgs.paths import whole

FOLDER = "textures"  # beside the mesh


@dataclass
class Textures:
    """Square maps of S×S texels, float32, the first row at v = 1.

    base_color (S, S, 3) linear Rec.709; metallic, roughness and occlusion (S, S); normal (S, S, 3), unit vectors in MikkTSpace
    tangent space, y along v (OpenGL, glTF and Blender); mask (S, S), true where a texel's centre lies on the mesh or one
    beside it does, so that look-ups on the mesh read nothing else: the rest is padding that repeats the nearest such texel.
    specular is 1, or 0 where nothing is mirrored anywhere.
    """

    base_color: np.ndarray
    metallic: np.ndarray
    roughness: np.ndarray
    occlusion: np.ndarray
    normal: np.ndarray
    mask: np.ndarray
    specular: float = 1.0


def write_textures(folder: Path, textures: Textures) -> dict[str, np.ndarray]:
    """Write the maps as 8-bit PNG and as linear float EXR (the normal mapped to 0..1 in both), for 8 bits are coarse on a mirror; each
    file whole or not at all. Returns the 8-bit ones by their names, base colour sRGB-encoded."""
    maps = {
        "base_color": textures.base_color,
        "metallic": textures.metallic,
        "roughness": textures.roughness,
        "occlusion": textures.occlusion,
        "normal": 0.5 + 0.5 * textures.normal,
    }
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {}
    for name, linear in maps.items():
        pictures[name] = np.empty(linear.shape, np.uint8)
        for row, values in zip(pictures[name], linear, strict=True):  # one at a time: of large maps copies are large
            row[:] = np.rint(255 * (srgb_encode(values.clip(0, 1)) if name == "base_color" else values.clip(0, 1)))
        png = io.BytesIO()
        Image.fromarray(pictures[name]).save(png, "PNG")
        with whole(folder / f"{name}.png") as temporary:
            temporary.write_bytes(png.getvalue())
        write_exr(folder / f"{name}.exr", linear)
    return pictures
