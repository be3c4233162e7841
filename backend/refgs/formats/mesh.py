"""Hold triangle meshes; read and write them as PLY files."""

import os
from dataclasses import dataclass

import numpy as np
import trimesh

from refgs.errors import InputError
from refgs.paths import whole

Y_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # rotation from Z up to the Y up of glTF (2.0, 3.4) and OBJ


@dataclass
class Mesh:
    """Hold a triangle mesh.

    - vertices (V, 3): float64, in world units
    - faces (F, 3): vertex indices, counter-clockwise as seen from outside
    - normals (V, 3), optional: smooth unit normals
    - uv (V, 2), optional: in 0..1, with v upward
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    uv: np.ndarray | None = None

    @classmethod
    def empty(cls) -> "Mesh":
        return cls(np.zeros((0, 3)), np.zeros((0, 3), np.int64))


def write_mesh(path: str | os.PathLike, mesh: Mesh) -> None:
    """Write a mesh's vertices and faces as a binary PLY file. A failed write leaves no partial file."""
    with whole(path) as temporary:
        temporary.write_bytes(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type="ply"))


def read_mesh(path: str | os.PathLike) -> Mesh:
    """Read a mesh that `write_mesh` wrote. Raises InputError for a broken file."""
    try:
        mesh = trimesh.load_mesh(path, file_type="ply", process=False)
        return Mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces))
    except Exception as error:  # trimesh raises errors of many types
        raise InputError(f"{path} is not a whole PLY file of a mesh ({error}): train again") from None
