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
    """Square maps of S×S texels, float32, the first row at v = 1.

    - base_color (S, S, 3), linear Rec.709
    - metallic, roughness and occlusion (S, S)
    - normal (S, S, 3): unit vectors in MikkTSpace tangent space, y along v (OpenGL, glTF and Blender)
    - mask (S, S): true where the centre of a texel or of one of its neighbours lies on the mesh. Bilinear look-ups on the mesh read only
      these; the others are padding, copied from the nearest one.
    - specular: 1, or 0 for a material without specular reflection
    """

    base_color: np.ndarray
    metallic: np.ndarray
    roughness: np.ndarray
    occlusion: np.ndarray
    normal: np.ndarray
    mask: np.ndarray
    specular: float = 1.0


def write_textures(folder: Path, textures: Textures) -> dict[str, np.ndarray]:
    """Write each map as 8-bit PNG and as linear float EXR, each file whole or not at all. 8 bits alone are coarse for a mirror.

    Normals are mapped to 0..1 in both. Returns the 8-bit pictures by name, base colour sRGB-encoded.
    """
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
        for row, values in zip(pictures[name], linear, strict=True):  # row by row: a copy of a large map is large
            row[:] = np.rint(255 * (srgb_encode(values.clip(0, 1)) if name == "base_color" else values.clip(0, 1)))
        png = io.BytesIO()
        Image.fromarray(pictures[name]).save(png, "PNG")
        with whole(folder / f"{name}.png") as temporary:
            temporary.write_bytes(png.getvalue())
        write_exr(folder / f"{name}.exr", linear)
    return pictures
