"""Hold triangle meshes; read and write them as PLY files."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import trimesh

from refgs.errors import InputError, reason
from refgs.formats.ply import check_header
from refgs.paths import open_file, whole

FARTHEST = 1e30  # of a vertex, in world units: squares of single-precision numbers must be finite
Y_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # rotation from Z up to the Y up of glTF (2.0, 3.4) and OBJ


@dataclass
class Mesh:
    """Hold a triangle mesh: vertices (V, 3) in world units, counter-clockwise faces (F, 3)."""

    vertices: np.ndarray
    faces: np.ndarray

    @staticmethod
    def empty() -> "Mesh":
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))


@dataclass
class SmoothMesh(Mesh):
    """Hold a triangle mesh with smooth unit normals (V, 3)."""

    normals: np.ndarray


@dataclass
class UnwrappedMesh(SmoothMesh):
    """Hold a smooth mesh with texture coordinates `uv` (V, 2) in 0..1, v upward."""

    uv: np.ndarray


def write_mesh(path: str | os.PathLike, mesh: Mesh) -> None:
    """Write vertices and faces as binary PLY, completely or not at all."""
    with whole(path) as temporary:
        data = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type="ply")
        temporary.write_bytes(cast(bytes, data))


def read_mesh(path: str | os.PathLike) -> Mesh:
    """Read a mesh that `write_mesh` wrote. Raises InputError for a broken file."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} is missing, or is no file: train again")
    try:
        with open_file(path) as file:
            check_header(file, path)
        mesh = trimesh.load_mesh(path, file_type="ply", process=False)
        mesh = Mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces))
    except InputError:
        raise
    except Exception as error:  # trimesh raises errors of many types
        raise InputError(f"{path} is not a whole PLY file of a mesh ({reason(error)}): train again") from None
    check_mesh(path, mesh)
    return mesh


def check_mesh(path: str | os.PathLike, mesh: Mesh) -> None:
    """Raise InputError, which names the file `path`, if a mesh is broken.

    A mesh is broken if it has no faces, if a face names a vertex that does not exist, or if a coordinate is not finite or beyond FARTHEST.
    """
    vertices, faces = mesh.vertices, mesh.faces
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        raise InputError(f"{path} has no triangles: write it again")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{path} has triangles of vertices that are not there: write it again")
    if not np.isfinite(vertices).all() or np.abs(vertices).max() > FARTHEST:
        raise InputError(f"{path} has vertices that are not finite: write it again")
