from dataclasses import replace

import bpy
import numpy as np
import pytest
from scipy.spatial import cKDTree

from refgs.formats.obj import write_obj
from tests.makers.box import textured_box


@pytest.fixture
def imported(tmp_path, scene):
    folder = tmp_path / "a run, été"
    folder.mkdir()
    mesh, textures = textured_box()
    write_obj(folder / "le pot.obj", mesh, textures)
    before = set(bpy.data.objects)
    bpy.ops.wm.obj_import(filepath=str(folder / "le pot.obj"))
    (found,) = set(bpy.data.objects) - before
    bpy.context.view_layer.update()
    return found, mesh


def test_it_stands_as_it_was(imported):
    found, mesh = imported
    places = np.array([found.matrix_world @ vertex.co for vertex in found.data.vertices])
    assert np.abs(places.min(axis=0) - mesh.vertices.min(axis=0)).max() < 1e-5
    assert np.abs(places.max(axis=0) - mesh.vertices.max(axis=0)).max() < 1e-5
    assert len(found.data.polygons) == len(mesh.faces)
    uv = np.array([loop.uv for loop in found.data.uv_layers.active.data])
    order = np.array([loop.vertex_index for loop in found.data.loops])
    corners = np.hstack([places[order], uv])
    expected = np.hstack([mesh.vertices, mesh.uv])
    assert cKDTree(expected).query(corners)[0].max() < 1e-4 > cKDTree(corners).query(expected)[0].max()


def test_its_material_has_its_pictures(imported):
    found, _ = imported
    (material,) = found.data.materials
    shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")

    for name in ("Base Color", "Roughness", "Metallic"):  # Blender ignores `norm`
        image = shader.inputs[name].links[0].from_node.image
        assert image.filepath.endswith(f"{name.lower().replace(' ', '_')}.png") and tuple(image.size) == (64, 64)


def test_what_mirrors_nothing_is_not_given_gloss(tmp_path, scene):
    mesh, textures = textured_box()
    write_obj(tmp_path / "a.obj", mesh, replace(textures, specular=0.0))
    bpy.ops.wm.obj_import(filepath=str(tmp_path / "a.obj"))
    (material,) = bpy.data.objects["RefGS"].data.materials
    shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    assert shader.inputs["Specular IOR Level"].default_value == 0
