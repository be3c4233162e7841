"""Test Blender's own import of splats in glTF: it has no splats there, but shows points and keeps the materials as attributes."""

import bpy
import numpy as np

from refgs.export.turned import turned
from refgs.formats.mesh import Y_UP
from refgs.formats.splats_gltf import write_splats_glb
from tests.makers.splats import make

COUNT = 50


def test_points_with_materials(tmp_path, scene):
    splats = make(COUNT)
    write_splats_glb(tmp_path / "des éclats.glb", turned(splats, Y_UP))
    bpy.ops.import_scene.gltf(filepath=str(tmp_path / "des éclats.glb"))
    bpy.context.view_layer.update()
    (found,) = (item for item in bpy.data.objects if item.type == "MESH")
    assert len(found.data.vertices) == COUNT and not found.data.polygons
    places = np.array([found.matrix_world @ vertex.co for vertex in found.data.vertices])
    np.testing.assert_allclose(places, splats.positions, atol=1e-6)

    def values(name):
        numbers = np.empty(COUNT * 3, np.float32)
        found.data.attributes[name].data.foreach_get("vector", numbers)
        return numbers.reshape(COUNT, 3)

    np.testing.assert_array_equal(values("_METALLIC_ROUGHNESS")[:, 2], splats.metallic)
    np.testing.assert_array_equal(values("_METALLIC_ROUGHNESS")[:, 1], splats.roughness)
    np.testing.assert_array_equal(values("_BASE_COLOR"), splats.albedo)
