"""Test that splats are deleted as points of a mesh, stay deleted in exports, and come back."""

import bpy
import numpy as np
import pytest
from plyfile import PlyData

from refgs.formats.splats import write_splats
from refgs_addon.nodes.kept_tree import NAME
from refgs_addon.scene.deleted_splats import add_points, count_deleted, points_of, restore
from refgs_addon.scene.edit import add_edit, is_edited
from refgs_addon.scene.export_run import export_mesh, export_run, export_splats
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.run_parts import show
from tests.makers.blender import attribute, brightness_from_above, drawn
from tests.makers.runs import COUNT
from tests.makers.splats import make

GONE = [3, 17, 39]


def delete(points, rows):
    """Delete vertices of a mesh of points as the artist does: select them in Edit Mode, and press X."""
    bpy.context.view_layer.objects.active = points
    points.data.vertices.foreach_set("select", np.isin(np.arange(len(points.data.vertices)), rows))
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.delete(type="VERT")


@pytest.fixture
def run(run):
    """Show the splats of the imported run, moved, and delete three of them."""
    show(run.collection, "splats")
    run.root.location, run.root.scale = (5, -4, 3), (0.1, 0.1, 0.1)
    delete(add_points(run.splats), GONE)
    return run


def test_deleted_points_are_splats_that_are_not_drawn(run):
    roughness = attribute(run.splats.data, "roughness")
    np.testing.assert_array_equal(drawn(run.splats, "roughness"), np.delete(roughness, GONE))  # in Edit Mode already
    bpy.ops.object.mode_set(mode="OBJECT")
    np.testing.assert_array_equal(drawn(run.splats, "roughness"), np.delete(roughness, GONE))
    assert add_points(run.splats) == points_of(run.splats)
    delete(points_of(run.splats), [0])
    bpy.ops.object.mode_set(mode="OBJECT")
    np.testing.assert_array_equal(drawn(run.splats, "roughness"), np.delete(roughness, [0, *GONE]))
    restore(run.splats)
    np.testing.assert_array_equal(drawn(run.splats, "roughness"), roughness)
    assert points_of(run.splats) is None and NAME not in run.splats.modifiers
    assert not any("to delete" in item.name for item in [*bpy.data.objects, *bpy.data.meshes])


def test_the_points_stand_where_the_splats_do(run):
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.view_layer.update()
    points = points_of(run.splats)
    np.testing.assert_allclose(points.matrix_world, run.splats.matrix_world, atol=1e-6)
    places = np.array([vertex.co for vertex in points.data.vertices])
    np.testing.assert_array_equal(places, np.delete(attribute(run.splats.data, "position"), GONE, axis=0))


def test_what_was_deleted_is_not_exported(run, run_folder, tmp_path):
    bpy.ops.object.mode_set(mode="OBJECT")
    before = PlyData.read(str(run_folder / "splats.ply"))["vertex"].data
    edit = add_edit(run.collection, material="Chrome")
    export_splats(run.collection, tmp_path / "a.ply")
    after = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    np.testing.assert_array_equal(after["x"], np.delete(before["x"], GONE))
    np.testing.assert_allclose(after["metallic"], 1.0)
    run.splats.modifiers.remove(edit)
    export_mesh(run.collection, tmp_path / "a.glb")
    assert (tmp_path / "a.glb").read_bytes() == (run_folder / "mesh.glb").read_bytes()
    export_run(run.collection, tmp_path / "new")
    assert not (tmp_path / "new" / "mesh.glb").exists()
    again = import_run(tmp_path / "new", bpy.context.scene)
    assert len(again.splats.data.points) == COUNT - len(GONE)
    np.testing.assert_allclose(attribute(again.splats.data, "metallic"), np.delete(before["metallic"], GONE), atol=1e-6)


@pytest.mark.parametrize("cut", [False, True])
def test_a_cut_shows_no_black_backs(scene, tmp_path, cut):
    """Check that backs, which are black, are lit once a splat is deleted: one looks into the object."""
    splats = make(2, 1)
    splats.positions[:] = [[0, 0, 0], [0, 0, 0.1]]
    splats.normals[:], splats.rotations[:] = (0, 0, -1), (0, 1, 0, 0)
    splats.scales[:], splats.opacities[:], splats.albedo[:], splats.sh[:] = 2.0, 0.999, 0.8, 0.8
    splats.roughness[:], splats.metallic[:] = 1, 1
    write_splats(tmp_path / "a.ply", splats)
    run = import_run(tmp_path / "a.ply", scene)
    points = add_points(run.splats)
    if cut:
        delete(points, [1])
        bpy.ops.object.mode_set(mode="OBJECT")
    seen = brightness_from_above(run, scene, tmp_path)
    assert seen > 0.3 if cut else seen < 0.1


def test_buttons_delete_and_restore(run_folder, addon):
    run = import_run(run_folder, addon)
    show(run.collection, "splats")
    bpy.ops.refgs.delete_splats(splats=run.splats.name)
    points = points_of(run.splats)
    assert points.mode == "EDIT" and bpy.context.active_object == points and points.hide_render
    assert not points.show_in_front  # all points together would cover the object
    assert not is_edited(run.splats)  # nothing is deleted yet
    bpy.ops.object.mode_set(mode="OBJECT")
    assert len(drawn(run.splats, "roughness")) == COUNT and not is_edited(run.splats)
    delete(points, GONE)
    assert is_edited(run.splats) and count_deleted(run.splats) == len(GONE)
    bpy.ops.refgs.restore_splats(splats=run.splats.name)
    assert len(drawn(run.splats, "roughness")) == COUNT and points_of(run.splats) is None
