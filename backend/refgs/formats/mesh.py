"""Triangle meshes, and the PLY files of their vertices and faces."""

import os
from dataclasses import dataclass

import numpy as np
import trimesh

from refgs.errors import InputError
from refgs.paths import whole

Y_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # from ours, Z up, to glTF's (2.0, 3.4) and OBJ's


@dataclass
class Mesh:
    """Triangles. vertices (V, 3) float64 in world units, faces (F, 3) integers, counter-clockwise seen from outside;
    smooth unit normals (V, 3) and uv (V, 2) in 0..1 with v upward, where they have been made."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    uv: np.ndarray | None = None

    @classmethod
    def empty(cls) -> "Mesh":
        return cls(np.zeros((0, 3)), np.zeros((0, 3), np.int64))


def write_mesh(path: str | os.PathLike, mesh: Mesh) -> None:
    """Write vertices and faces as a binary PLY, whole or not at all."""
    with whole(path) as temporary:
        temporary.write_bytes(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type="ply"))


def read_mesh(path: str | os.PathLike) -> Mesh:
    """Read what `write_mesh` wrote. Raises InputError for a file that is broken."""
    try:
        mesh = trimesh.load_mesh(path, file_type="ply", process=False)
        return Mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces))
    except Exception as error:  # trimesh raises what its parsing ran into
        raise InputError(f"{path} is not a whole PLY file of a mesh ({error}): train again") from None
