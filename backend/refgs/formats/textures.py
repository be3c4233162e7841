"""Write the texture maps of a mesh as PNG and EXR."""

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
    """Hold the square texture maps of a mesh, S×S texels: float32, except `mask`. The first row is at v = 1.

    - base_color (S, S, 3), linear Rec.709
    - metallic, roughness and occlusion (S, S)
    - normal (S, S, 3): unit vectors in MikkTSpace tangent space, y along v (OpenGL, glTF and Blender)
    - mask (S, S), bool: true for a texel if its centre, or a neighbour's centre, lies in a triangle of the uv layout. A bilinear look-up on
      the mesh reads only these texels. The other texels are padding: copies of the nearest texel in the mask.
    - doubt (S, S) in 0..1: 0 where photos show whether the surface is metal or paint, 1 where they leave it open; None if unknown
    - specular: 1, or 0 for a material without specular reflection
    """

    base_color: np.ndarray
    metallic: np.ndarray
    roughness: np.ndarray
    occlusion: np.ndarray
    normal: np.ndarray
    mask: np.ndarray
    specular: float = 1.0
    doubt: np.ndarray | None = None


def write_textures(folder: Path, textures: Textures) -> dict[str, np.ndarray]:
    """Write each texture map twice: as 8-bit PNG, and as linear float EXR. Returns the 8-bit pictures by name.

    The EXR files are needed for mirror-like surfaces, on which the steps of 8-bit normals are visible. Normals are mapped to 0..1 in both
    files. Base colour is sRGB-encoded in the PNG. A failed write leaves no partial file.
    """
    maps = {
        "base_color": textures.base_color,
        "metallic": textures.metallic,
        "roughness": textures.roughness,
        "occlusion": textures.occlusion,
        "normal": 0.5 + 0.5 * textures.normal,
    }
    if textures.doubt is not None:
        maps["doubt"] = textures.doubt
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {}
    for name, linear in maps.items():
        pictures[name] = np.empty(linear.shape, np.uint8)
        for row, values in zip(pictures[name], linear, strict=True):  # row by row: a copy of a large map is large
            row[:] = np.rint(255 * (srgb_encode(values.clip(0, 1)) if name == "base_color" else values.clip(0, 1)))
        png = io.BytesIO()
        Image.fromarray(pictures[name]).save(png, "PNG")
        with whole(folder / f"{name}.png") as temporary:
            temporary.write_bytes(png.getvalue())
        write_exr(folder / f"{name}.exr", linear)
    return pictures
