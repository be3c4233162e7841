"""Test the export of an imported run with its material edits. The run's own files must not change."""

import json
import shutil

import bpy
import numpy as np
import pytest

from refgs.color import srgb_decode
from refgs_addon.errors import InputError
from refgs_addon.ply_file import read_rows
from refgs_addon.scene.edit import add_edit
from refgs_addon.scene.export_run import SH_DC, edited_materials, export_light, export_mesh, export_run, export_splats
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.run_parts import show
from tests.makers.runs import COUNT, random_columns, write_ply


def test_splats_without_edits_are_those_of_the_run(run, run_folder, tmp_path):
    export_splats(run.collection, tmp_path / "a.ply")
    assert (tmp_path / "a.ply").read_bytes()[-40 * 84 :] == (run_folder / "splats.ply").read_bytes()[-40 * 84 :]
    np.testing.assert_array_equal(read_rows(tmp_path / "a.ply"), read_rows(run_folder / "splats.ply"))


@pytest.mark.parametrize("part", ["splats", "mesh"])
def test_edits_are_written_and_nothing_else_changes(run, run_folder, tmp_path, part):
    show(run.collection, part)  # Blender does not evaluate hidden splats
    before = read_rows(run_folder / "splats.ply").copy()
    edit = add_edit(run.collection, "Box", "Gold")
    export_splats(run.collection, tmp_path / "a.ply")
    after = read_rows(tmp_path / "a.ply")
    inside = np.isclose(after["metallic"], 1.0) & np.isclose(after["roughness"], 0.15)
    outside = after["metallic"] == before["metallic"]
    assert 0 < inside.sum() < len(after) and outside.any()
    np.testing.assert_allclose(after["albedo_r"][inside], 1.0, rtol=1e-5)
    for name in ("albedo_g", "roughness", "f_dc_1"):
        np.testing.assert_allclose(after[name][outside], before[name][outside], atol=1e-6)
    for name in ("x", "opacity", "rot_2", "scale_1"):
        np.testing.assert_array_equal(after[name], before[name])
    assert (run.splats.hide_viewport, run.mesh[0].visible_camera) == (part == "mesh", part == "mesh")
    edit.show_viewport = False
    np.testing.assert_allclose(edited_materials(run.splats)["metallic"], before["metallic"])


def test_a_viewer_without_lights_shows_the_new_colour(run, run_folder, tmp_path):
    """Check that changing the base colour scales the stored colours by the same factor.

    Viewers without lights show the stored colours.
    """
    rows = read_rows(run_folder / "splats.ply").copy()
    edit = add_edit(run.collection)
    run.splats.data.attributes["base_color"].data.foreach_set("color", [0.4, 0.4, 0.4, 1.0] * 40)
    edit.show_viewport = False
    export_splats(run.collection, tmp_path / "a.ply")
    after = read_rows(tmp_path / "a.ply")

    def light(rows):
        look = np.clip(0.5 + SH_DC * np.stack([rows[f"f_dc_{i}"] for i in range(3)]), 0, 1)
        return srgb_decode(look) / np.stack([rows[f"albedo_{c}"] for c in "rgb"]).clip(0.02)

    before = light(rows)
    shown = before * 0.4 < 1  # more is beyond white
    assert shown.mean() > 0.5
    np.testing.assert_allclose(light(after)[shown], before[shown], rtol=1e-3, atol=1e-6)


def test_a_new_run_has_the_edits_and_can_be_imported(run, run_folder, scene, tmp_path):
    listing = {file.name: file.read_bytes() for file in run_folder.iterdir()}
    add_edit(run.collection, material="Chrome")
    export_run(run.collection, tmp_path / "chrome été")
    assert {file.name: file.read_bytes() for file in run_folder.iterdir()} == listing
    assert sorted(p.name for p in tmp_path.iterdir()) == ["chrome été", "pot"]
    second = import_run(tmp_path / "chrome été", scene)
    assert second.mesh == [] and list(second.cameras) == list(run.cameras)
    assert edited_materials(second.splats)["metallic"] == pytest.approx(1.0)
    with pytest.raises(InputError, match="exists: choose another name"):
        export_run(run.collection, tmp_path / "chrome été")


def test_without_edits_the_mesh_comes_along(run, tmp_path, scene):
    export_run(run.collection, tmp_path / "copy")
    assert (tmp_path / "copy" / "mesh.glb").is_file()
    export_mesh(run.collection, tmp_path / "a.glb")
    export_light(run.collection, tmp_path / "a.exr")
    add_edit(run.collection)
    with pytest.raises(InputError, match="has no uv map to bake edits into: make the run's mesh again"):
        export_mesh(run.collection, tmp_path / "b.glb")
    assert not (tmp_path / "b.glb").exists()


def test_what_is_not_there_is_said_in_one_line(run, run_folder, tmp_path):
    with pytest.raises(InputError, match=r"cannot write .*not there"):
        export_splats(run.collection, tmp_path / "not there" / "a.ply")
    with pytest.raises(InputError, match=r"cannot write .*not there"):
        export_run(run.collection, tmp_path / "not there" / "run")
    (run_folder / "environment.exr").unlink()
    with pytest.raises(InputError, match="has no light"):
        export_light(run.collection, tmp_path / "a.exr")
    shutil.rmtree(run_folder)
    with pytest.raises(InputError, match="press Find Run Folder"):
        export_splats(run.collection, tmp_path / "a.ply")
    assert list(tmp_path.iterdir()) == []


def test_the_file_menu(run_folder, addon, tmp_path):
    bpy.ops.refgs.import_run(directory=f"{run_folder}/")
    bpy.ops.refgs.add_edit(where="Everywhere", material="Rubber")
    bpy.ops.refgs.export_splats(filepath=str(tmp_path / "a.ply"))
    bpy.ops.refgs.apply_edits(filepath=str(tmp_path / "rubber"))
    assert [known.folder for known in addon.refgs.runs] == [str(tmp_path / "rubber")]
    assert np.allclose(read_rows(tmp_path / "rubber" / "splats.ply")["roughness"], 0.9)
    assert (tmp_path / "a.ply").stat().st_size > 0
    assert json.loads((tmp_path / "rubber" / "cameras.json").read_text())["frames"]


def test_colour_by_direction_goes_with_the_material_it_was_of(run_folder, scene, tmp_path):
    columns = random_columns()
    write_ply(run_folder / "splats.ply", columns | {f"f_rest_{i}": np.full(COUNT, 0.1 + i) for i in range(9)})
    run = import_run(run_folder, scene)
    add_edit(run.collection, "Box", "Gold")
    export_splats(run.collection, tmp_path / "a.ply")
    after = read_rows(tmp_path / "a.ply")
    edited = after["metallic"] != columns["metallic"].astype(np.float32)
    assert 0 < edited.sum() < len(after)
    for i in range(9):
        np.testing.assert_allclose(after[f"f_rest_{i}"], np.where(edited, 0, 0.1 + i), rtol=1e-6)
