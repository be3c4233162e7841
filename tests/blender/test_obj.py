from dataclasses import replace

import bpy
import numpy as np
import pytest
from scipy.spatial import cKDTree

from refgs.formats.obj import write_obj
from tests.makers.blender import principled
from tests.makers.box import textured_box


def imported(file, mesh, textures):
    """Write an OBJ file, import it into the empty scene, and return the new object."""
    write_obj(file, mesh, textures)
    bpy.ops.wm.obj_import(filepath=str(file))
    bpy.context.view_layer.update()
    (found,) = bpy.data.objects
    return found


@pytest.fixture
def box(tmp_path, scene):
    """Write a textured box to an OBJ file and import it. Returns the imported object and the written mesh."""
    mesh, textures = textured_box()
    (tmp_path / "a run, été").mkdir()
    return imported(tmp_path / "a run, été" / "le pot.obj", mesh, textures), mesh


def test_it_stands_as_it_was(box):
    found, mesh = box
    places = np.array([found.matrix_world @ vertex.co for vertex in found.data.vertices])
    assert np.abs(places.min(axis=0) - mesh.vertices.min(axis=0)).max() < 1e-5
    assert np.abs(places.max(axis=0) - mesh.vertices.max(axis=0)).max() < 1e-5
    assert len(found.data.polygons) == len(mesh.faces)
    uv = np.array([loop.uv for loop in found.data.uv_layers.active.data])
    order = np.array([loop.vertex_index for loop in found.data.loops])
    corners = np.hstack([places[order], uv])
    expected = np.hstack([mesh.vertices, mesh.uv])
    assert cKDTree(expected).query(corners)[0].max() < 1e-4 > cKDTree(corners).query(expected)[0].max()


def test_its_material_has_its_pictures(box):
    (material,) = box[0].data.materials
    for name in ("Base Color", "Roughness", "Metallic"):  # Blender ignores `norm`
        image = principled(material).inputs[name].links[0].from_node.image
        assert image.filepath.endswith(f"{name.lower().replace(' ', '_')}.png") and tuple(image.size) == (64, 64)


def test_what_mirrors_nothing_is_not_given_gloss(tmp_path, scene):
    mesh, textures = textured_box()
    found = imported(tmp_path / "a.obj", mesh, replace(textures, specular=0.0))
    assert found.name == "RefGS"
    assert principled(found.data.materials[0]).inputs["Specular IOR Level"].default_value == 0
