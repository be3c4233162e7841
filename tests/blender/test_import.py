"""Test the import of a run: compare Blender's data with values computed in numpy."""

import json
from pathlib import Path

import bpy
import numpy as np
import pytest
import trimesh
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector
from plyfile import PlyData, PlyElement

from refgs.color import srgb_decode
from refgs.errors import InputWarning
from refgs.formats.splats import read_splats as read_by_refgs
from refgs_addon import compat
from refgs_addon.errors import InputError
from refgs_addon.nodes import splats_tree
from refgs_addon.nodes.splat_material import VALUES_NAME
from refgs_addon.nodes.splats_tree import NAME
from refgs_addon.scene.camera_objects import frame_camera, next_camera, photo_shown, show_photo
from refgs_addon.scene.edit import add_edit
from refgs_addon.scene.export_run import export_mesh, export_splats
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.place_run import put_beside
from refgs_addon.scene.regions import REGION
from refgs_addon.scene.run_parts import cameras, parts, show
from refgs_addon.scene.run_toml import newer_release
from refgs_addon.scene.splat_cloud import MATERIALS, normal_slopes, read_splats
from refgs_addon.scene.world_light import relight
from tests.makers.blender import attribute, drawn, drawn_axes, drawn_material, drawn_splats
from tests.makers.box import rewrite_glb
from tests.makers.distances import spread
from tests.makers.runs import COUNT, FRAMES, SIZE, quaternion_matrix, random_columns, write_ply


def stacked(columns, names):
    """Stack the columns of splats.ply that `names` lists (such as "x y z") side by side: (N, number of names)."""
    return np.stack([columns[name] for name in names.split()], axis=1)


def test_a_light_that_turned_is_said_to(run_folder, scene):
    assert "refgs_light_of" not in import_run(run_folder, scene).world
    file = run_folder / "cameras.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"light_of": "images/shifted"}))
    run = import_run(run_folder, scene)
    assert run.light_of == run.world["refgs_light_of"] == "shifted"
    assert "shifted" in run.cameras


def test_photos_with_dots_in_their_names(run_folder, scene):
    names = ["render.0001", "render.0002"]
    file = run_folder / "cameras.json"
    data = json.loads(file.read_text())
    for name, frame in zip(names, data["frames"], strict=True):
        frame["file_path"] = f"images/{name}"
    file.write_text(json.dumps(data | {"light_of": "images/render.0002"}))
    run = import_run(run_folder, scene)
    assert list(run.cameras) == [camera.name for camera in run.cameras.values()] == names
    assert run.light_of == "render.0002"


@pytest.mark.parametrize(
    ("made_by", "is_newer"), [('"0.2.9"', False), ('"0.10.0"', True), ('"99.0"', True), ("5", False), ('"x"', False)]
)
def test_a_run_of_a_newer_release(run_folder, made_by, is_newer):
    (run_folder / "run.toml").write_text(f"[run]\nrefgs = {made_by}\n")
    assert newer_release(run_folder) == (json.loads(made_by) if is_newer else "")
    (run_folder / "run.toml").unlink()
    assert newer_release(run_folder) == ""


def test_points_hold_what_the_file_holds(run):
    columns, cloud = random_columns(), run.splats.data
    assert len(cloud.points) == COUNT
    close = {"rtol": 1e-5, "atol": 1e-6}
    np.testing.assert_allclose(attribute(cloud, "position"), stacked(columns, "x y z"), **close)
    np.testing.assert_allclose(attribute(cloud, "normal"), stacked(columns, "nx ny nz"), **close)
    np.testing.assert_allclose(attribute(cloud, "rotation"), stacked(columns, "rot_0 rot_1 rot_2 rot_3"), **close)
    np.testing.assert_allclose(attribute(cloud, "scale")[:, :2], np.exp(stacked(columns, "scale_0 scale_1")), **close)
    np.testing.assert_allclose(attribute(cloud, "opacity"), 1 / (1 + np.exp(-columns["opacity"])), **close)
    np.testing.assert_allclose(
        attribute(cloud, "base_color")[:, :3], stacked(columns, "albedo_r albedo_g albedo_b"), **close
    )
    np.testing.assert_allclose(attribute(cloud, "metallic"), columns["metallic"], **close)
    np.testing.assert_allclose(attribute(cloud, "roughness"), columns["roughness"], **close)


def test_splats_are_drawn_where_they_lie(run):
    show(run.collection, "splats")
    columns = random_columns()
    centres, axes = drawn_axes(run.splats)
    assert len(centres) == COUNT
    expected = quaternion_matrix(stacked(columns, "rot_0 rot_1 rot_2 rot_3"))[:, :, :2]
    expected = expected * np.exp(stacked(columns, "scale_0 scale_1"))[:, None]
    np.testing.assert_allclose(centres, stacked(columns, "x y z"), atol=2e-6)
    np.testing.assert_allclose(axes, np.swapaxes(expected, 1, 2), atol=2e-6)
    np.testing.assert_allclose(drawn(run.splats, "roughness"), columns["roughness"], atol=1e-6)
    if not compat.DRAWS_SPLATS:
        corners = attribute(drawn_splats(run.splats), "gaussian").reshape(COUNT, 4, 3)
        assert (corners == corners[0]).all()
        return
    np.testing.assert_allclose(drawn(run.splats, "radiance:base")[:, 3], drawn(run.splats, "opacity"), atol=1e-6)
    assert (drawn(run.splats, "scale")[:, 2] > 0).all()
    for number, name in enumerate(("gaussian_u", "gaussian_v")):
        along = np.einsum("nij,nj->ni", axes, drawn(run.splats, name))
        np.testing.assert_allclose(along, np.tile(np.eye(2)[number], (COUNT, 1)), atol=1e-4)


@pytest.mark.skipif(not compat.DRAWS_SPLATS, reason="this Blender draws quads")
def test_a_file_of_an_earlier_blender_keeps_quads(run_folder, scene, monkeypatch):
    with monkeypatch.context() as earlier:
        earlier.setattr(splats_tree, "DRAWS_SPLATS", False)
        import_run(run_folder, scene)
    run = import_run(run_folder, scene)
    show(run.collection, "splats")
    graph = bpy.context.evaluated_depsgraph_get()
    shown = [i.object for i in graph.object_instances if i.object.original == run.splats]
    assert "MESH" in {item.type for item in shown}
    nodes = run.splats.data.materials[0].node_tree.nodes
    assert "gaussian" in {node.attribute_name for node in nodes if node.type == "ATTRIBUTE"}


def test_size_opacity_cut_and_display(run):
    show(run.collection, "splats")
    columns, modifier = random_columns(), run.splats.modifiers[NAME]
    whole = drawn_axes(run.splats)
    compat.set_modifier_input(modifier, "Size", 0.5)
    half = drawn_axes(run.splats)
    np.testing.assert_allclose(half[0], whole[0], atol=1e-6)
    np.testing.assert_allclose(half[1], whole[1] / 2, atol=1e-6)

    compat.set_modifier_input(modifier, "Opacity Cut", 0.6)
    kept = 1 / (1 + np.exp(-columns["opacity"])) >= 0.6
    assert 0 < kept.sum() < COUNT
    compat.set_modifier_input(modifier, "Display", "Metallic")
    assert drawn_material(run.splats) == VALUES_NAME
    shown = drawn(run.splats, "display")
    np.testing.assert_allclose(shown[:, :3], np.repeat(columns["metallic"][kept, None], 3, axis=1), atol=1e-6)
    compat.set_modifier_input(modifier, "Display", "Normal")
    shown = drawn(run.splats, "display")
    np.testing.assert_allclose(shown[:, :3], stacked(columns, "nx ny nz")[kept] / 2 + 0.5, atol=1e-6)
    compat.set_modifier_input(modifier, "Display", "Shaded")
    assert drawn_material(run.splats) == "pot splats"


def test_normals_bend_as_a_sphere_does(tmp_path):
    count, radius = 600, 2.0
    columns = random_columns(count)
    normal = spread(count)
    # The shortest rotation from z to the normal: (1 + z, z × n), normalised.
    quaternion = np.stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], np.zeros(count)], axis=1)
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    for i, axis in enumerate("xyz"):
        columns[axis], columns["n" + axis] = radius * normal[:, i], normal[:, i]
    columns |= {f"rot_{i}": quaternion[:, i] for i in range(4)}
    write_ply(tmp_path / "splats.ply", columns)
    splats, _ = read_splats(tmp_path / "splats.ply")
    for axis, slope in enumerate(normal_slopes(splats)):
        step = quaternion_matrix(quaternion)[:, :, axis] * np.exp(columns[f"scale_{axis}"])[:, None]
        expected = step / radius  # dn = dp / radius
        error = np.linalg.norm(slope - expected, axis=1) / np.linalg.norm(expected, axis=1)
        assert np.median(error) < 0.1 and error.max() < 0.3


def foreign_columns(scales, normals):
    """Make the columns of a PLY file of splats from another program.

    The file has no materials. `scales` is the number of its scale columns: 2 or 3. Quaternions are not normalised. If
    `normals` is true, the file has normals, which are all zero.
    """
    rng = np.random.default_rng(4)
    columns = {name: value for name, value in random_columns().items() if name not in MATERIALS}
    for i in range(4):
        columns[f"rot_{i}"] *= 3
    columns |= {f"scale_{i}": rng.uniform(-4, -2, COUNT) for i in range(scales)}
    for name in ("nx", "ny", "nz"):
        columns[name] *= 0
        if not normals:
            del columns[name]
    return columns | {f"f_rest_{i}": np.zeros(COUNT) for i in range(45)}


@pytest.mark.parametrize("normals", [False, True])
@pytest.mark.parametrize("scales", [2, 3])
def test_other_programs_splats(scene, tmp_path, scales, normals):
    """Check the import of splats from other programs.

    They become matte discs, perpendicular to their shortest axis, with the colours that those programs show.
    """
    columns = foreign_columns(scales, normals)
    folder = tmp_path / "d'un autre été"
    folder.mkdir()
    write_ply(folder / "splats.ply", columns)
    cloud = import_run(folder, scene).splats.data
    turn = quaternion_matrix(stacked(columns, "rot_0 rot_1 rot_2 rot_3") / 3)
    size = np.exp(np.stack([columns[f"scale_{i}"] for i in range(scales)], axis=1))
    shortest = size.argmin(axis=1) if scales == 3 else np.full(COUNT, 2)
    axis = np.take_along_axis(turn, shortest[:, None, None], axis=2)[:, :, 0]
    np.testing.assert_allclose(attribute(cloud, "normal"), axis, atol=1e-5)
    found = quaternion_matrix(attribute(cloud, "rotation"))[:, :, :2] * attribute(cloud, "scale")[:, None, :2]
    flat = turn[:, :, :scales] * size[:, None] * (np.arange(scales) != shortest[:, None])[:, None]
    covariances = [sides @ sides.transpose(0, 2, 1) for sides in (found, flat)]
    np.testing.assert_allclose(*covariances, atol=1e-6)
    look = (0.5 + stacked(columns, "f_dc_0 f_dc_1 f_dc_2") / np.sqrt(4 * np.pi)).clip(0, 1)
    np.testing.assert_allclose(attribute(cloud, "base_color")[:, :3], srgb_decode(look), atol=1e-5)
    assert (attribute(cloud, "metallic") == 0).all() and (attribute(cloud, "roughness") == 1).all()


def test_splats_that_are_not_finite_are_left_out(run_folder, addon, tmp_path, capfd):
    """Check that an import leaves out splats with NaN or infinite values, as the trainer does.

    An infinite opacity is kept: stored as a logit, it stands for 0 or 1. Columns that the add-on does not know are kept, and exported
    again.
    """
    columns = {**random_columns(), "semantic": np.arange(COUNT), "weight": np.linspace(0, 1, COUNT)}
    columns |= {f"f_rest_{i}": np.zeros(COUNT) for i in range(9)}
    columns["x"][3], columns["roughness"][[5, 6]], columns["f_rest_4"][7] = np.nan, np.inf, np.nan
    columns["opacity"][8:11] = np.inf, -np.inf, np.nan
    other = PlyElement.describe(np.array([(1, 2)], [("width", "<i4"), ("height", "<i4")]), "camera")
    rows = np.zeros(COUNT, [(name, {"semantic": "u1", "weight": "<f8"}.get(name, "<f4")) for name in columns])
    for name, value in columns.items():
        rows[name] = value
    PlyData([PlyElement.describe(rows, "vertex"), other], byte_order="<").write(str(run_folder / "splats.ply"))
    kept = np.setdiff1d(np.arange(COUNT), [3, 5, 6, 7, 10])
    with pytest.warns(InputWarning, match="5 of 40 splats"):
        assert len(read_by_refgs(run_folder / "splats.ply")) == len(kept)

    bpy.ops.refgs.import_run(directory=f"{run_folder}/")
    assert "5 splats with values that are not finite were left out" in capfd.readouterr().out
    run = import_run(run_folder, addon)
    assert run.left_out == 5
    cloud = run.splats.data
    np.testing.assert_array_equal(attribute(cloud, "position"), stacked(columns, "x y z")[kept].astype(np.float32))
    np.testing.assert_array_equal(attribute(cloud, "opacity")[np.isin(kept, [8, 9])], [1, 0])
    assert all(np.isfinite(attribute(cloud, name)).all() for name in ("normal_u", "normal_v"))

    add_edit(run.collection)
    export_splats(run.collection, tmp_path / "edited.ply")
    again = PlyData.read(str(tmp_path / "edited.ply"))["vertex"]
    assert again["semantic"].tolist() == kept.tolist()
    assert (again["semantic"].dtype, again["weight"].dtype) == ("u1", "f8")
    np.testing.assert_array_equal(again["weight"], columns["weight"][kept])
    np.testing.assert_array_equal(again["x"], columns["x"][kept].astype(np.float32))
    assert (again["metallic"] == 1).all() and (again["f_rest_4"] == 0).all()


def test_edits_of_what_has_no_materials_cannot_be_written(scene, tmp_path):
    (tmp_path / "other").mkdir()
    write_ply(tmp_path / "other" / "splats.ply", foreign_columns(3, True))
    run = import_run(tmp_path / "other", scene)
    with pytest.raises(InputError, match=r"has no materials to edit: give its splats .* --splats"):
        export_splats(run.collection, tmp_path / "edited.ply")
    assert not (tmp_path / "edited.ply").exists()


def test_one_splat_alone_is_flat(tmp_path):
    write_ply(tmp_path / "splats.ply", random_columns(1))
    assert all((slope == 0).all() for slope in normal_slopes(read_splats(tmp_path / "splats.ply")[0]))


def test_one_splat_and_a_mesh_without_faces(run_folder, scene, tmp_path):
    """Check that a run of one splat and a mesh without faces can be imported, edited and exported."""
    write_ply(run_folder / "splats.ply", random_columns(1))
    trimesh.Scene(trimesh.PointCloud(np.eye(3))).export(run_folder / "mesh.glb")
    run = import_run(run_folder, scene)
    assert len(run.splats.data.points) == len(drawn(run.splats, "opacity")) == 1
    assert [len(item.data.polygons) for item in run.mesh] == [0]
    (run_folder / "textures").mkdir()
    picture = bpy.data.images.new("picture", 4, 4)
    for name in ("base_color", "metallic", "roughness", "normal", "occlusion"):
        picture.save(filepath=str(run_folder / "textures" / f"{name}.png"))
    for ending in (".glb", ".usdc", ".fbx"):
        export_mesh(run.collection, tmp_path / f"un point{ending}")
        assert (tmp_path / f"un point{ending}").stat().st_size
    add_edit(run.collection)
    show(run.collection, "mesh")
    export_splats(run.collection, tmp_path / "one.ply")
    assert PlyData.read(str(tmp_path / "one.ply"))["vertex"].count == 1


def test_mesh_stands_where_the_splats_are(run):
    (mesh,) = run.mesh
    corners = np.array([mesh.matrix_world @ v.co for v in mesh.data.vertices])
    np.testing.assert_allclose(corners.min(axis=0), [0.9, -3.3, 1.8], atol=1e-5)
    np.testing.assert_allclose(corners.max(axis=0), [1.1, -2.7, 2.2], atol=1e-5)
    assert mesh.users_collection == (run.collection,) and mesh.parent == run.root


@pytest.mark.parametrize("unit", [0.001, 0.01, 1.0, 25.0])
def test_all_parts_are_of_one_size_in_a_scene_of_any_unit(run_folder, scene, unit):
    usual = import_run(run_folder, scene)
    scene.unit_settings.scale_length = unit
    run = import_run(run_folder, scene)
    scene.view_layers[0].update()
    assert scene.unit_settings.scale_length == pytest.approx(unit)
    (mesh,), (other,) = run.mesh, usual.mesh
    assert np.allclose(mesh.matrix_world, other.matrix_world) and np.allclose(mesh.bound_box, other.bound_box)
    assert mesh.dimensions == other.dimensions and run.splats.dimensions == usual.splats.dimensions
    for camera, before in zip(run.cameras.values(), usual.cameras.values(), strict=True):
        assert np.allclose(camera.matrix_world, before.matrix_world)


def test_one_empty_moves_the_whole_run(run, scene):
    add_edit(run.collection, "Box")
    (region,) = (item for item in run.collection.objects if item.get(REGION))
    show(run.collection, "splats")
    cameras(run.collection).hide_viewport = False  # hidden objects are not evaluated
    items = [run.splats, run.mesh[0], region, *run.cameras.values()]
    bpy.context.view_layer.update()
    before = [np.array(item.matrix_world) for item in (*items, run.root)]
    np.testing.assert_allclose(before[-1][:3, 3], [1.0, -3.0, 1.8], atol=1e-5)  # under the middle of the mesh
    run.root.location, run.root.rotation_euler, run.root.scale = (2, 1, 0), (0.3, 0.2, 0.1), (0.5, 0.5, 0.5)
    bpy.context.view_layer.update()
    moved = np.array(run.root.matrix_world) @ np.linalg.inv(before[-1])
    for item, was in zip(items, before, strict=False):
        np.testing.assert_allclose(np.array(item.matrix_world), moved @ was, atol=1e-5)


def test_the_true_size_is_typed_in(run_folder, addon):
    run = import_run(run_folder, addon)
    assert run.root.refgs_longest_side == pytest.approx(0.6, rel=1e-5)
    run.root.scale = (2, 2, 2)
    assert run.root.refgs_longest_side == pytest.approx(1.2, rel=1e-5)
    run.root.refgs_longest_side = 0.15
    bpy.context.view_layer.update()
    corners = np.array([run.mesh[0].matrix_world @ v.co for v in run.mesh[0].data.vertices])
    assert np.ptp(corners, axis=0).max() == pytest.approx(0.15, rel=1e-4)


def test_without_a_mesh_the_empty_stands_under_the_splats(run_folder, scene):
    (run_folder / "mesh.glb").unlink()
    run = import_run(run_folder, scene)
    place = attribute(run.splats.data, "position")
    low, high = (np.sort(place, axis=0)[i] for i in (0, -2))  # 2 % of 40 splats are none at one side, one at the other
    np.testing.assert_allclose(run.root.location, [*(low + high)[:2] / 2, low[2]], atol=1e-5)


def test_cameras_are_hidden_and_still_looked_through(run, scene):
    shown = cameras(run.collection)
    assert shown.hide_viewport and {item for item in shown.objects if item.type == "CAMERA"} == {*run.cameras.values()}
    shown.hide_viewport = False
    for camera in run.cameras.values():  # Blender draws a dashed line to a parent that it shows
        assert camera.visible_get() and not camera.parent.visible_get()
    assert next_camera(scene, cameras(run.collection)) == run.cameras["shifted"] == scene.camera


def test_cameras_project_as_the_photos_did(run, scene):
    assert list(run.cameras) == ["front", "shifted"] and scene.camera == run.cameras["front"]
    point = np.array([0.3, -0.2, 0.4])
    for frame in FRAMES:
        camera = run.cameras[frame["file_path"].rpartition("/")[2]]
        frame_camera(scene, camera)
        bpy.context.view_layer.update()
        assert (scene.render.resolution_x, scene.render.resolution_y) == (frame["w"], frame["h"])
        x, y, z = (np.linalg.inv(frame["transform_matrix"]) @ [*point, 1])[:3]
        u, v = frame["cx"] - frame["fl_x"] * x / z, frame["cy"] + frame["fl_y"] * y / z  # from the top left corner
        seen = world_to_camera_view(scene, camera, Vector(point))
        np.testing.assert_allclose([seen.x * frame["w"], (1 - seen.y) * frame["h"], seen.z], [u, v, -z], atol=1e-3)


def with_photos(run_folder, capture):
    """Write two photos into the new folder `capture`, and make the run refer to them."""
    file = run_folder / "cameras.json"
    content = json.loads(file.read_text())
    for frame in content["frames"]:
        frame["photo"] = f"photos/{frame['file_path'].rpartition('/')[2]}.png"
    file.write_text(json.dumps(content))
    (run_folder / "run.toml").write_text(f"[run]\ncapture = {json.dumps(str(capture))}\n")
    (capture / "photos").mkdir(parents=True)
    picture = bpy.data.images.new("photo", 8, 8)
    for name in ("front", "shifted"):
        picture.save(filepath=str(capture / "photos" / f"{name}.png"))
    bpy.data.images.remove(picture)


def test_photos_lie_over_what_their_cameras_see(run_folder, scene, tmp_path):
    with_photos(run_folder, tmp_path / "été 'photos'")
    run = import_run(run_folder, scene)
    front, shifted = run.cameras.values()
    assert not bpy.data.images.get("front.png") and photo_shown(front) == 0
    show_photo(front, 0.5)
    (layer,) = front.data.background_images
    assert layer.image.name == "front.png" and tuple(layer.image.size) == (8, 8) and photo_shown(front) == 0.5
    assert next_camera(scene, run.collection) == shifted == scene.camera
    assert (photo_shown(front), photo_shown(shifted)) == (0, 0.5)
    assert (scene.render.resolution_x, scene.render.resolution_y) == (SIZE, 40)
    show_photo(shifted, 0)
    assert next_camera(scene, run.collection, -1) == front and photo_shown(front) == 0
    show_photo(front)
    assert len(front.data.background_images) == 1 and photo_shown(front) == 1


def test_the_camera_of_a_photo_is_visible(run_folder, scene, tmp_path):
    """Check that Blender can draw a photo, which it does for visible cameras only. A run's cameras are hidden."""
    with_photos(run_folder, tmp_path / "photos")
    run = import_run(run_folder, scene)
    front, shifted = run.cameras.values()
    front.hide_set(True)
    show_photo(front, 0.5)
    assert (front.visible_get(), shifted.visible_get()) == (True, False)
    assert next_camera(scene, run.collection) == shifted
    assert (front.visible_get(), shifted.visible_get()) == (False, True)
    show_photo(shifted, 0)
    assert not shifted.visible_get() and {*cameras(run.collection).objects} > {front, shifted}
    shifted.hide_viewport, cameras(run.collection).hide_viewport = False, False
    scene.collection.objects.link(shifted)
    cameras(run.collection).objects.unlink(shifted)  # moved by the artist
    show_photo(shifted)
    show_photo(shifted, 0)
    assert shifted.name in scene.objects


def test_a_photo_that_is_gone_is_said_in_one_line(run, run_folder, scene, tmp_path):
    with pytest.raises(InputError, match="front has no photo"):
        show_photo(run.cameras["front"])
    with_photos(run_folder, tmp_path / "capture")
    run = import_run(run_folder, scene)
    (tmp_path / "capture" / "photos" / "front.png").unlink()
    with pytest.raises(InputError, match=r"front\.png does not exist: move the capture back"):
        show_photo(run.cameras["front"])


def test_frame_camera_to_another_size(run, scene):
    frame_camera(scene, run.cameras["shifted"], size=SIZE // 2)
    assert (scene.render.resolution_x, scene.render.resolution_y) == (SIZE // 2, 20)


def test_importing_twice_gives_two_runs(run, run_folder, scene):
    first, second = run, import_run(run_folder, scene)
    assert first.collection.name == "RefGS pot" and second.collection.name == "RefGS pot.001"
    assert first.splats.modifiers[NAME].node_group == second.splats.modifiers[NAME].node_group
    assert first.splats.data.materials[0] != second.splats.data.materials[0]
    assert list(second.cameras) == ["front", "shifted"] and scene.world == second.world


def test_all_worlds_are_saved_with_the_file(run_folder, scene, tmp_path):
    """Check that saving keeps the artist's own world, and the lights of runs that are not shown."""
    scene.world = bpy.data.worlds.new("the artist's own")
    names = [scene.world.name, *(import_run(run_folder, scene).world.name for _ in range(2))]
    scene.world = bpy.data.worlds[names[0]]
    relight(scene, run_folder / "environment.exr")
    names.append(scene.world.name)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert names == ["the artist's own", "RefGS pot", "RefGS pot.001", "RefGS Light"]
    assert {world.name for world in bpy.data.worlds} == set(names)


def test_optional_parts_may_be_missing(run_folder, scene):
    for name in ("mesh.glb", "environment.exr", "cameras.json"):
        (run_folder / name).unlink()
    run = import_run(run_folder, scene)
    assert len(run.splats.data.points) == COUNT
    assert run.mesh == [] and run.world is None and run.cameras == {} and scene.world is None


def test_the_mesh_is_shown_first_and_show_hides_the_other_part(run):
    assert set(parts(run.collection)) == {"splats", "mesh"}
    assert run.splats.hide_render and run.splats.hide_viewport
    assert run.mesh[0].visible_camera and not run.mesh[0].hide_render and not run.mesh[0].hide_viewport
    show(run.collection, "splats")
    assert not run.splats.hide_render and not run.splats.hide_viewport
    assert not run.mesh[0].visible_camera and not run.mesh[0].hide_render  # it casts the splats' shadows


def cut(path):
    path.write_bytes(path.read_bytes()[:-7])


def not_json(path):
    path.write_text("{")


def infinite(path):
    write_ply(path, {**random_columns(), "metallic": np.full(COUNT, np.nan)})


def without_properties(path):
    path.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nend_header\n")


def without_materials(path):
    write_ply(path, {k: v for k, v in random_columns().items() if k not in ("metallic", "roughness")})


def replacing(old, new):
    """Return a function that replaces the bytes `old` by `new` in the file at a path."""
    return lambda path: path.write_bytes(path.read_bytes().replace(old, new))


def changed_camera(**values):
    """Return a function that writes a cameras.json of one camera, with these values changed."""
    return lambda path: path.write_text(json.dumps({"frames": [FRAMES[0] | values]}))


def names_another_file(path):
    rewrite_glb(path, lambda tree: tree["buffers"].__setitem__(0, {"uri": "/etc/passwd", "byteLength": 64}))


@pytest.mark.parametrize(
    ("name", "spoil", "says"),
    [
        ("splats.ply", Path.unlink, "is not a run"),
        ("splats.ply", cut, "truncated"),
        ("splats.ply", replacing(b"element vertex ", b"element vertex x"), "broken header"),
        ("splats.ply", replacing(b"property float y", b"property float x"), "broken header"),
        ("splats.ply", replacing(b"element vertex ", b"element vertex -"), "broken header"),
        ("splats.ply", without_properties, "element without properties"),
        ("splats.ply", replacing(b"property float y", b"property list uchar float y"), "not a whole PLY file"),
        ("splats.ply", replacing(b"element vertex", b"element face 0\nelement vertex"), "element without properties"),
        ("splats.ply", replacing(b"property float y", b"property floaty y"), "broken header"),
        ("splats.ply", not_json, "not a PLY file"),
        ("splats.ply", infinite, "has no splat with finite values"),
        ("splats.ply", without_materials, "has no metallic, roughness"),
        ("cameras.json", not_json, "no whole JSON file"),
        ("cameras.json", lambda path: path.write_text('{"frames": ' + "[" * 50_000), "no whole JSON file"),
        ("cameras.json", changed_camera(transform_matrix=[[1, 2], [3, 4]]), "not the cameras.json"),
        ("cameras.json", changed_camera(w=0), "not the cameras.json"),
        ("cameras.json", changed_camera(fl_y=-1.0), "not the cameras.json"),
        ("cameras.json", changed_camera(cx=10**400), "not the cameras.json"),
        ("environment.exr", not_json, "not a complete EXR"),
        ("mesh.glb", cut, "glTF"),
        ("mesh.glb", names_another_file, "names a file outside of its folder"),
    ],
)
def test_a_broken_folder_leaves_nothing_behind(run_folder, scene, name, spoil, says):
    spoil(run_folder / name)
    own = scene.world = bpy.data.worlds.new("the artist's own")
    before = set(bpy.data.user_map())  # all data-blocks, of every kind
    with pytest.raises(InputError, match=says) as error:
        import_run(run_folder, scene)
    assert "\n" not in str(error.value) and name in str(error.value)
    assert set(bpy.data.user_map()) == before
    assert scene.world == own and not own.use_fake_user and scene.camera is None


def test_what_is_no_run_is_named(run_folder, scene):
    (run_folder / "splats.ply").unlink()
    with pytest.raises(InputError, match=r"pot is not a run: it has no splats\.ply"):
        import_run(run_folder, scene)
    (run_folder / "run.toml").touch()
    with pytest.raises(InputError, match=r"the training of .*pot has not ended"):
        import_run(run_folder, scene)
    with pytest.raises(InputError, match=r"splats.ply is not a folder"):
        import_run(run_folder / "splats.ply", scene)


def test_a_run_stands_beside_what_was_in_its_place(run_folder, addon):
    def box(item):
        bpy.context.view_layer.update()
        corners = np.array([item.matrix_world @ Vector(corner) for corner in item.bound_box])
        return corners.min(axis=0), corners.max(axis=0)

    bpy.ops.mesh.primitive_cube_add(size=2, location=(1, -3, 2))  # like Blender's default cube, around the mesh
    bpy.ops.mesh.primitive_cube_add(size=0.1, location=(2.1, -3, 2))
    bpy.ops.mesh.primitive_cube_add(size=9, location=(0, 0, 0))  # a room
    cubes = list(addon.objects)
    bpy.ops.refgs.import_run(directory=str(run_folder))
    (mesh,) = (item for item in addon.objects if item.name == "pot mesh")
    low, high = box(mesh)
    assert low[0] > box(cubes[1])[1][0] and low[0] < 2.4
    np.testing.assert_allclose([*low[1:], *high[1:]], [-3.3, 1.8, -2.7, 2.2], atol=1e-5)
    for cube in cubes:
        bpy.data.objects.remove(cube)
    again = import_run(run_folder, addon)
    assert put_beside(again.collection, bpy.context.view_layer) is None
    np.testing.assert_allclose(box(again.mesh[0])[0], [0.9, -3.3, 1.8], atol=1e-5)


@pytest.mark.parametrize("meshes", [True, False])
def test_a_solid_view_shows_the_materials_of_what_is_imported(run_folder, addon, meshes):
    """Check that import switches Solid views to Material Preview and leaves others, and that so does the button of the splats."""
    if not meshes:
        (run_folder / "mesh.glb").unlink()
    (area,) = (area for area in bpy.context.screen.areas if area.type == "VIEW_3D")
    shading = area.spaces.active.shading
    for before, after in (("SOLID", "MATERIAL"), ("RENDERED", "RENDERED"), ("WIREFRAME", "WIREFRAME")):
        shading.type = before
        bpy.ops.refgs.import_run(directory=str(run_folder))
        assert shading.type == after and (before != "SOLID" or shading.use_scene_world)
    for part, after in (("mesh", "SOLID"), ("splats", "MATERIAL")):
        shading.type = "SOLID"
        bpy.ops.refgs.show(collection="RefGS pot", part=part)
        assert shading.type == after


def test_eevee_traces_rays_as_the_artist_wants(run_folder, scene):
    import_run(run_folder, scene)
    assert scene.eevee.use_raytracing and scene.eevee.ray_tracing_options.resolution_scale == "1"
    scene.eevee.ray_tracing_options.resolution_scale = "4"
    import_run(run_folder, scene)
    assert scene.eevee.ray_tracing_options.resolution_scale == "4"
