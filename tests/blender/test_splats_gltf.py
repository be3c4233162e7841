"""Test Blender's own import of splats in glTF: it keeps the materials as attributes. Blender 5.3 shows splats, earlier ones points."""

import bpy
import numpy as np
from mathutils import Vector

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
    (found,) = (item for item in bpy.data.objects if item.type in ("MESH", "POINTCLOUD"))

    def values(name, width=3):
        numbers = np.empty(COUNT * width, np.float32)
        found.data.attributes[name].data.foreach_get("vector", numbers)
        return numbers.reshape(COUNT, width)

    places = np.array([found.matrix_world @ Vector(place) for place in values("position")])
    np.testing.assert_allclose(places, splats.positions, atol=1e-6)
    if found.type == "POINTCLOUD":
        assert found.data.type == "GAUSSIAN_SPLAT"
        np.testing.assert_allclose(values("radiance:base", width=4)[:, 3], splats.opacities, atol=1e-6)
    else:
        assert not found.data.polygons
    np.testing.assert_array_equal(values("_METALLIC_ROUGHNESS")[:, 2], splats.metallic)
    np.testing.assert_array_equal(values("_METALLIC_ROUGHNESS")[:, 1], splats.roughness)
    np.testing.assert_array_equal(values("_BASE_COLOR"), splats.albedo)
