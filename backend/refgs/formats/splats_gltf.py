"""Write splats as binary glTF 2.0 with the extension KHR_gaussian_splatting."""

import json
import os
import struct
from pathlib import Path

import numpy as np

from refgs.color import srgb_decode
from refgs.errors import InputError
from refgs.formats.splats import DC, Splats, three_scales
from refgs.paths import whole

EXTENSION = "KHR_gaussian_splatting"
LARGEST = 0xFFFFFFFF  # bytes of a binary glTF file, by its header (glTF 2.0, 4.4.2)
_FLOAT, _VERTICES, _POINTS = 5126, 34962, 0  # glTF's numbers: a component type, a buffer's target, a primitive's mode
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_splats_glb(path: str | os.PathLike, splats: Splats) -> None:
    """Write splats as a binary glTF file, with the Khronos extension KHR_gaussian_splatting (kernel `ellipse`) and float32 values.

    The splats must have glTF's axes, Y up: see `refgs.export.turned`. Colours by direction are sRGB-encoded, with the primaries of Rec.709.

    - COLOR_0 has the constant part of the colour, linear, and the opacity. Programs without the extension show points in it.
    - Materials are application-specific attributes, which viewers ignore: _BASE_COLOR (linear Rec.709), _NORMAL, and _METALLIC_ROUGHNESS
      with the channels of glTF's texture of that name: green is perceptual roughness, blue is metallic.

    Raises InputError if there are no splats, which glTF cannot express, or too many for one file.
    """
    if not len(splats):
        raise InputError(f"{path}: there are no splats to write: a glTF file has at least one")
    colour = srgb_decode((0.5 + DC * splats.sh[:, 0]).clip(0, 1))
    attributes = {
        "POSITION": splats.positions,
        "COLOR_0": np.column_stack([colour, splats.opacities]),
        f"{EXTENSION}:ROTATION": splats.rotations[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": three_scales(splats),
        f"{EXTENSION}:OPACITY": splats.opacities[:, None],
    }
    for k in range(splats.sh.shape[1]):
        degree = int(k**0.5)
        attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k - degree**2}"] = splats.sh[:, k]
    # All of one type: the importer of Blender 4.5 fails on custom attributes of several.
    attributes |= {
        "_BASE_COLOR": splats.albedo,
        "_METALLIC_ROUGHNESS": np.column_stack([0 * splats.roughness, splats.roughness, splats.metallic]),
        "_NORMAL": splats.normals,
    }
    columns = [np.ascontiguousarray(column, "<f4") for column in attributes.values()]
    views, accessors, start = [], [], 0
    for number, column in enumerate(columns):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": column.nbytes, "target": _VERTICES})
        shape = {"componentType": _FLOAT, "count": len(splats), "type": _TYPES[column.shape[1]]}
        accessors.append({"bufferView": number, **shape})
        start += column.nbytes
    accessors[0] |= {"min": columns[0].min(axis=0).tolist(), "max": columns[0].max(axis=0).tolist()}
    primitive = {
        "attributes": {name: number for number, name in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    tree = {
        "asset": {"version": "2.0", "generator": "RefGS"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "RefGS", "mesh": 0}],
        "meshes": [{"name": "RefGS", "primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }
    text = json.dumps(tree).encode("ascii")
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + start
    if size > LARGEST:
        raise InputError(f"{path}: {len(splats):,} splats take more than the 4 GB of a glTF file: write a .ply")
    with whole(Path(path)) as temporary, open(temporary, "wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, size))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", start, b"BIN\0"))
        for column in columns:
            file.write(column.tobytes())
