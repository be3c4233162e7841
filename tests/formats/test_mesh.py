"""Test that meshes which would crash the ray tracer, or give it nothing to trace, are refused with one line."""

import numpy as np
import pytest
import trimesh

from refgs.errors import InputError
from refgs.formats.gltf import read_glb
from refgs.formats.mesh import Mesh, read_mesh, write_mesh

CORNERS = np.eye(3)
FACES = np.array([[0, 1, 2]])


@pytest.mark.parametrize(
    ("mesh", "says"),
    [
        (Mesh(CORNERS, FACES), None),
        (Mesh.empty(), "no triangles"),
        (Mesh(CORNERS, np.array([[0, 1, 3]])), "vertices that are not there"),
        (Mesh(CORNERS * np.nan, FACES), "not finite"),
        (Mesh(CORNERS * 1e35, FACES), "not finite"),
    ],
)
def test_a_mesh_that_cannot_be_traced(tmp_path, mesh, says):
    write_mesh(tmp_path / "a.ply", mesh)
    if says is None:
        np.testing.assert_array_equal(read_mesh(tmp_path / "a.ply").vertices, CORNERS)
        return
    with pytest.raises(InputError, match=says) as error:
        read_mesh(tmp_path / "a.ply")
    assert str(tmp_path / "a.ply") in str(error.value) and "\n" not in str(error.value)


def test_a_mesh_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="missing"):
        read_mesh(tmp_path / "a.ply")


def test_a_glb_of_points(tmp_path):
    trimesh.Scene(trimesh.PointCloud(CORNERS)).export(tmp_path / "a.glb")
    with pytest.raises(InputError, match=r"a\.glb"):
        read_glb(tmp_path / "a.glb")
