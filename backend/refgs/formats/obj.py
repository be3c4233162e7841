"""Write textured meshes as Wavefront OBJ, with their textures beside them."""

import os
from pathlib import Path

import numpy as np

from refgs.formats.mesh import Y_UP, UnwrappedMesh
from refgs.formats.textures import FOLDER, Textures, write_textures
from refgs.paths import whole


def write_obj(path: str | os.PathLike, mesh: UnwrappedMesh, textures: Textures) -> None:
    """Write a textured mesh as a Wavefront OBJ file, with its material in an MTL file. The mesh is turned from Z up to Y up.

    The material names the pictures that `write_textures` writes beside it. Its keys are the usual ones for PBR: map_Kd (base colour),
    map_Pm (metallic), map_Pr (roughness) and norm.
    """
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
    corner = (mesh.faces + 1).repeat(3, axis=1).reshape(-1, 9)  # position, uv and normal share an index
    with whole(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        file.write(f"mtllib {path.with_suffix('.mtl').name}\no RefGS\n")
        np.savetxt(file, mesh.vertices @ Y_UP.T, "v %.9g %.9g %.9g")
        np.savetxt(file, mesh.uv, "vt %.9g %.9g")
        np.savetxt(file, mesh.normals @ Y_UP.T, "vn %.6g %.6g %.6g")
        file.write("usemtl RefGS\n")
        np.savetxt(file, corner, "f" + " %d/%d/%d" * 3)
