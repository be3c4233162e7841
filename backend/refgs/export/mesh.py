"""mesh.glb: the textured mesh as binary glTF 2.0, with its textures beside it."""

import io
import os
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

from refgs.color import srgb_encode
from refgs.export.bake import Textures
from refgs.export.environment import write_exr
from refgs.geometry.mesh import Mesh


def write_glb(path: str | os.PathLike, mesh: Mesh, textures: Textures) -> None:
    """Write the mesh (Z up; with normals and uv) as Y-up binary glTF with a metallic-roughness material.

    Embedded: base colour (sRGB), roughness and metallic (G and B, linear) and the tangent-space normal map; tangents
    are left to the reader, which makes them by MikkTSpace as `bake` assumed. Beside the file, in textures/, the same
    maps as 8-bit PNG and as linear float EXR (the normal mapped to 0..1 in both), for 8 bits are coarse on a mirror.
    Each file is written whole or not at all.
    """
    path = Path(path)
    maps = {
        "base_color": textures.base_color,
        "metallic": textures.metallic,
        "roughness": textures.roughness,
        "normal": 0.5 + 0.5 * textures.normal,
    }
    folder = path.parent / "textures"
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {}
    for name, linear in maps.items():
        pictures[name] = _bytes(srgb_encode(linear.clip(0, 1)) if name == "base_color" else linear)
        png = io.BytesIO()
        Image.fromarray(pictures[name]).save(png, "PNG")
        _write(folder / f"{name}.png", png.getvalue())
        write_exr(folder / f"{name}.exr", linear)

    roughness, metallic = pictures["roughness"], pictures["metallic"]
    material = PBRMaterial(
        name="RefGS",
        baseColorTexture=Image.fromarray(pictures["base_color"]),
        metallicRoughnessTexture=Image.fromarray(
            np.dstack([np.full_like(roughness, 255), roughness, metallic])  # red is occlusion's, if a reader looks
        ),
        normalTexture=Image.fromarray(pictures["normal"]),
        metallicFactor=1.0,
        roughnessFactor=1.0,
        doubleSided=True,  # a capture from above leaves a mesh without a bottom
    )
    y_up = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # glTF 2.0, 3.4: +Y is up
    model = trimesh.Trimesh(
        mesh.vertices @ y_up.T,
        mesh.faces,
        vertex_normals=mesh.normals @ y_up.T,
        visual=trimesh.visual.TextureVisuals(uv=mesh.uv, material=material),
        process=False,
    )
    scene = trimesh.Scene()
    scene.add_geometry(model, node_name="RefGS", geom_name="RefGS")
    _write(path, scene.export(file_type="glb", include_normals=True))


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.rint(values.clip(0, 1) * 255).astype(np.uint8)


def _write(path: Path, data: bytes) -> None:
    temporary = path.with_name(path.name + ".tmp")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
