"""Test that Blender's own importers read display splats as Gaussian splats, from Blender 5.3."""

import bpy
import numpy as np
import pytest

from refgs.formats.splats import write_display_splats
from refgs.formats.splats_usd import write_splats_usd
from tests.makers.splats import make

COUNT = 50
NATIVE = "type" in bpy.types.PointCloud.bl_rna.properties
pytestmark = pytest.mark.skipif(not NATIVE, reason="this Blender has no splats")


@pytest.mark.parametrize(
    ("ending", "write", "read"),
    [(".ply", write_display_splats, "ply_import"), (".usdc", write_splats_usd, "usd_import")],
)
def test_they_are_splats(tmp_path, scene, ending, write, read):
    splats = make(COUNT)
    write(tmp_path / f"éclats{ending}", splats)
    getattr(bpy.ops.wm, read)(filepath=str(tmp_path / f"éclats{ending}"))
    (found,) = (item for item in bpy.data.objects if item.type == "POINTCLOUD")
    assert found.data.type == "GAUSSIAN_SPLAT" and found.matrix_world.is_identity

    def values(name, width, field="vector"):
        numbers = np.empty(COUNT * width, np.float32)
        found.data.attributes[name].data.foreach_get(field, numbers)
        return numbers.reshape(COUNT, width)

    np.testing.assert_array_equal(values("position", 3), splats.positions)
    np.testing.assert_allclose(values("scale", 3)[:, :2], splats.scales, atol=1e-6)
    np.testing.assert_allclose(values("rotation", 4, "value"), splats.rotations, atol=1e-6)
    color = np.column_stack([splats.sh[:, 0], splats.opacities])
    np.testing.assert_allclose(values("radiance:base", 4), color, atol=1e-6)
    for number in range(15):
        np.testing.assert_array_equal(values(f"radiance:sh_{number}", 3), splats.sh[:, 1 + number])
