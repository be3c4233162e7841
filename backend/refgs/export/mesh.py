"""The textured mesh as binary glTF 2.0 or as Wavefront OBJ, with its textures beside it."""

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


FOLDER = "textures"  # beside the mesh
SPECULAR = "KHR_materials_specular"


def write_glb(path: str | os.PathLike, mesh: Mesh, textures: Textures) -> None:
    """Write the mesh (Z up; with normals and uv) as Y-up binary glTF with a metallic-roughness material.

    Embedded: base colour (sRGB), occlusion, roughness and metallic (R, G and B, linear), the tangent-space normal map and the
    tangents that `bake` assumed, MikkTSpace's: not every reader makes these. What mirrors nothing says so by KHR_materials_specular.
    Beside the file what `write_textures` writes.
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

    def finish(tree: dict) -> None:
        # trimesh takes tangents for an attribute of ours, and puts an underscore before it.
        attributes = tree["meshes"][0]["primitives"][0]["attributes"]
        attributes["TANGENT"] = attributes.pop("_TANGENT")
        if textures.specular < 1:
            tree["materials"][0]["extensions"] = {SPECULAR: {"specularFactor": textures.specular}}
            tree["extensionsUsed"] = [SPECULAR]

    scene = trimesh.Scene()
    scene.add_geometry(model, node_name="RefGS", geom_name="RefGS")
    with whole(path) as temporary:
        temporary.write_bytes(scene.export(file_type="glb", include_normals=True, tree_postprocessor=finish))


def write_obj(path: str | os.PathLike, mesh: Mesh, textures: Textures) -> None:
    """Write the mesh (Z up; with normals and uv) as Y-up Wavefront OBJ, its material beside it as MTL with what is customary for
    metallic and roughness (map_Pm, map_Pr, norm), which name the pictures that `write_textures` writes."""
    path = Path(path)
    write_textures(path.parent / FOLDER, textures)
    maps = {"map_Kd": "base_color", "map_Pr": "roughness", "map_Pm": "metallic", "norm": "normal"}
    specular = [] if textures.specular == 1 else ["Ks 0 0 0"]
    lines = [
        "newmtl RefGS",
        "Kd 1 1 1",
        *specular,
        "Pr 1",
        "Pm 1",
        *(f"{key} {FOLDER}/{name}.png" for key, name in maps.items()),
    ]
    with whole(path.with_suffix(".mtl")) as temporary:
        temporary.write_text("\n".join([*lines, ""]), encoding="utf-8")
    corner = (mesh.faces + 1).repeat(3, axis=1).reshape(-1, 9)  # one number for place, uv and normal
    with whole(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        file.write(f"mtllib {path.with_suffix('.mtl').name}\no RefGS\n")
        np.savetxt(file, mesh.vertices @ _Y_UP.T, "v %.9g %.9g %.9g")
        np.savetxt(file, mesh.uv, "vt %.9g %.9g")
        np.savetxt(file, mesh.normals @ _Y_UP.T, "vn %.6g %.6g %.6g")
        file.write("usemtl RefGS\n")
        np.savetxt(file, corner, "f" + " %d/%d/%d" * 3)


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


def read_glb(path: str | os.PathLike) -> Mesh:
    """Vertices and faces, Z up, of what `write_glb` wrote. Raises InputError for a file that is broken."""
    try:
        model = trimesh.load_mesh(path, file_type="glb", process=False, skip_materials=True)
        vertices, faces = np.asarray(model.vertices, np.float64), np.asarray(model.faces)
    except Exception as error:  # trimesh raises what its parsing ran into
        raise InputError(f"{path} is not a whole binary glTF file of a mesh ({error}): export it again") from None
    return Mesh(vertices @ _Y_UP, faces)
