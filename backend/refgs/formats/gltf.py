"""Read and write textured meshes as binary glTF 2.0. Textures are also written beside the mesh."""

import json
import os
import struct
from io import BytesIO
from pathlib import Path
from typing import cast

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from refgs.errors import InputError, reason
from refgs.formats.mesh import Y_UP, Mesh, UnwrappedMesh, check_mesh
from refgs.formats.tangents import vertex_tangents
from refgs.formats.textures import FOLDER, Textures, write_textures
from refgs.paths import open_file, whole

LARGEST = 512 << 20  # bytes of a file with four textures of 8192 pixels and a million triangles
SPECULAR = "KHR_materials_specular"


def write_glb(path: str | os.PathLike, mesh: UnwrappedMesh, textures: Textures) -> None:
    """Write a textured mesh as a binary glTF file. The mesh is turned from Z up to glTF's Y up.

    The file has one metallic-roughness material. These are stored in the file:

    - base colour, sRGB-encoded
    - occlusion, roughness and metallic, linear, as R, G and B of one picture
    - the normal map
    - the MikkTSpace tangents that the normal map was made with, because some programs do not compute tangents
    - the extension KHR_materials_specular, only if specular reflection must be turned off

    The maps are also written as files beside the mesh, by `write_textures`.
    """
    path = Path(path)
    pictures = write_textures(path.parent / FOLDER, textures)
    packed = Image.fromarray(np.dstack([pictures[name] for name in ("occlusion", "roughness", "metallic")]))
    material = PBRMaterial(
        name="RefGS",
        baseColorTexture=Image.fromarray(pictures["base_color"]),
        metallicRoughnessTexture=packed,
        occlusionTexture=packed,
        normalTexture=Image.fromarray(pictures["normal"]),
        metallicFactor=1.0,
        roughnessFactor=1.0,
        doubleSided=True,  # a capture from above leaves the mesh open below
    )
    model = trimesh.Trimesh(
        mesh.vertices @ Y_UP.T,
        mesh.faces,
        vertex_normals=mesh.normals @ Y_UP.T,
        visual=TextureVisuals(uv=mesh.uv, material=material),
        process=False,
    )
    tangents, signs = vertex_tangents(mesh)
    model.vertex_attributes["TANGENT"] = np.column_stack([tangents @ Y_UP.T, signs]).astype(np.float32)

    def finish(tree: dict) -> None:
        # trimesh treats tangents as a custom attribute and prefixes an underscore.
        attributes = tree["meshes"][0]["primitives"][0]["attributes"]
        attributes["TANGENT"] = attributes.pop("_TANGENT")
        if textures.specular < 1:
            tree["materials"][0]["extensions"] = {SPECULAR: {"specularFactor": textures.specular}}
            tree["extensionsUsed"] = [SPECULAR]

    scene = trimesh.Scene()
    scene.add_geometry(model, node_name="RefGS", geom_name="RefGS")
    with whole(path) as temporary:
        data = scene.export(file_type="glb", include_normals=True, tree_postprocessor=finish)
        temporary.write_bytes(cast(bytes, data))


def read_glb(path: str | os.PathLike) -> Mesh:
    """Read the vertices and faces of a file that `write_glb` wrote. They are turned back to Z up.

    Raises InputError for a broken file, and for a file that refers to other files, as glTF allows.
    """
    try:
        with open_file(path) as file:
            data = file.read(12)  # "glTF", the version and the length (glTF 2.0, 4.4.2)
            length = int.from_bytes(data[8:], "little")
            if data[:4] != b"glTF" or not 12 <= length <= LARGEST:
                raise ValueError("its header is another file's")
            data += file.read(length - 12)
        _check_self_contained(data)
        model = trimesh.load_mesh(BytesIO(data), file_type="glb", process=False, skip_materials=True)
        vertices, faces = np.asarray(model.vertices, np.float64), np.asarray(model.faces)
    except Exception as error:  # trimesh raises errors of many types
        raise InputError(
            f"{path} is not a whole binary glTF file of a mesh ({reason(error)}): export it again"
        ) from None
    mesh = Mesh(vertices @ Y_UP, faces)
    check_mesh(path, mesh)
    return mesh


def _check_self_contained(data: bytes) -> None:
    """Raise ValueError if binary glTF refers to other files, or declares more elements than bytes."""
    # Without this, a file could make its reader open any other file, or allocate any amount of memory.
    length, kind = struct.unpack_from("<I4s", data, 12)
    if kind != b"JSON":
        raise ValueError("it does not begin with JSON")
    tree = json.loads(data[20 : 20 + length])
    if any("uri" in entry for kind in ("buffers", "images") for entry in tree.get(kind, ())):
        raise ValueError("it names other files")
    if any(entry["count"] > len(data) for entry in tree.get("accessors", ())):
        raise ValueError("it has fewer numbers than it declares")
