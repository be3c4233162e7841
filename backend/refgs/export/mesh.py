"""mesh.glb: the textured mesh as binary glTF 2.0, with its textures beside it."""

import io
import os
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

from refgs.color import srgb_encode
from refgs.errors import InputError
from refgs.export.bake import Textures
from refgs.export.environment import write_exr
from refgs.export.tangents import vertex_tangents
from refgs.geometry.mesh import Mesh
from refgs.paths import whole

_Y_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # glTF 2.0, 3.4: +Y is up


def write_glb(path: str | os.PathLike, mesh: Mesh, textures: Textures) -> None:
    """Write the mesh (Z up; with normals and uv) as Y-up binary glTF with a metallic-roughness material.

    Embedded: base colour (sRGB), occlusion, roughness and metallic (R, G and B, linear), the tangent-space normal map and the
    tangents that `bake` assumed, MikkTSpace's: not every reader makes these. Beside the file, in textures/, the same maps as
    8-bit PNG and as linear float EXR (the normal mapped to 0..1 in both), for 8 bits are coarse on a mirror.
    Each file is written whole or not at all.
    """
    path = Path(path)
    maps = {
        "base_color": textures.base_color,
        "metallic": textures.metallic,
        "roughness": textures.roughness,
        "occlusion": textures.occlusion,
        "normal": 0.5 + 0.5 * textures.normal,
    }
    folder = path.parent / "textures"
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {}
    for name, linear in maps.items():
        pictures[name] = _bytes(srgb_encode(linear.clip(0, 1)) if name == "base_color" else linear)
        png = io.BytesIO()
        Image.fromarray(pictures[name]).save(png, "PNG")
        with whole(folder / f"{name}.png") as temporary:
            temporary.write_bytes(png.getvalue())
        write_exr(folder / f"{name}.exr", linear)

    packed = Image.fromarray(np.dstack([pictures[name] for name in ("occlusion", "roughness", "metallic")]))
    material = PBRMaterial(
        name="RefGS",
        baseColorTexture=Image.fromarray(pictures["base_color"]),
        metallicRoughnessTexture=packed,
        occlusionTexture=packed,
        normalTexture=Image.fromarray(pictures["normal"]),
        metallicFactor=1.0,
        roughnessFactor=1.0,
        doubleSided=True,  # a capture from above leaves a mesh without a bottom
    )
    model = trimesh.Trimesh(
        mesh.vertices @ _Y_UP.T,
        mesh.faces,
        vertex_normals=mesh.normals @ _Y_UP.T,
        visual=trimesh.visual.TextureVisuals(uv=mesh.uv, material=material),
        process=False,
    )
    tangents, signs = vertex_tangents(mesh)
    model.vertex_attributes["TANGENT"] = np.column_stack([tangents @ _Y_UP.T, signs]).astype(np.float32)
    scene = trimesh.Scene()
    scene.add_geometry(model, node_name="RefGS", geom_name="RefGS")
    with whole(path) as temporary:
        temporary.write_bytes(scene.export(file_type="glb", include_normals=True, tree_postprocessor=_named))


def _named(tree: dict) -> None:
    """trimesh takes tangents for an attribute of ours, and puts an underscore before it."""
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["TANGENT"] = attributes.pop("_TANGENT")


def read_glb(path: str | os.PathLike) -> Mesh:
    """Vertices and faces, Z up, of what `write_glb` wrote. Raises InputError for a file that is broken."""
    try:
        model = trimesh.load_mesh(path, file_type="glb", process=False, skip_materials=True)
        vertices, faces = np.asarray(model.vertices, np.float64), np.asarray(model.faces)
    except Exception as error:  # trimesh raises what its parsing ran into
        raise InputError(f"{path} is not a whole binary glTF file of a mesh ({error}): export it again") from None
    return Mesh(vertices @ _Y_UP, faces)


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.rint(values.clip(0, 1) * 255).astype(np.uint8)
