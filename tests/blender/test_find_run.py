"""Test that a run whose folder was moved or copied is found again, and that nothing of the artist's work is lost."""

import json
import os
import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest

from refgs_addon import jobs
from refgs_addon.errors import InputError
from refgs_addon.nodes.panorama_world import IMAGE, RECOVERED
from refgs_addon.ply_file import read_rows
from refgs_addon.scene.edit import add_edit
from refgs_addon.scene.export_run import export_splats
from refgs_addon.scene.export_run import run_folder as folder_of
from refgs_addon.scene.find_run import find_run
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.run_parts import FOLDER
from refgs_addon.scene.world_light import match_light, relight
from tests.makers.runs import FRAMES, random_columns, write_panorama, write_ply, write_run


def collection():
    return next(item for item in bpy.data.collections if FOLDER in item)


def opened(file):
    """Save the open file as `file`, open that, and return its scene."""
    bpy.ops.wm.save_as_mainfile(filepath=str(file))
    bpy.ops.wm.open_mainfile(filepath=str(file))
    return bpy.context.scene


@pytest.fixture
def edited(run_folder, addon, tmp_path):
    """Import a run, edit it, light it with an HDRI, and move its folder away. Returns the folder's new place. The saved .blend is open."""
    panorama = np.random.default_rng(0).uniform(0.1, 1.0, (16, 32, 3))
    write_panorama(run_folder / "environment.exr", panorama)
    write_panorama(tmp_path / "hdri.exr", 2 * panorama)
    add_edit(import_run(run_folder, addon).collection, material="Rubber")
    known = addon.refgs.runs.add()
    known.folder = str(run_folder)
    relight(addon, tmp_path / "hdri.exr")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    (tmp_path / "archive").mkdir()
    moved = shutil.move(run_folder, tmp_path / "archive" / "pot of clay")
    opened(tmp_path / "a.blend")
    return moved


def test_the_light_of_a_moved_run_is_in_the_blend(edited, addon):
    match_light(bpy.context.scene)
    relight(bpy.context.scene, None)
    assert min(bpy.context.scene.world.node_tree.nodes[IMAGE].image.size) > 0


def test_a_moved_run_is_found_with_its_edits(edited, addon, tmp_path):
    with pytest.raises(InputError, match="press Find Run Folder in the panel Run"):
        export_splats(collection(), tmp_path / "a.ply")
    bpy.ops.refgs.find_run(folder=collection()[FOLDER], directory=f"{edited}/")
    export_splats(collection(), tmp_path / "a.ply")
    assert np.allclose(read_rows(tmp_path / "a.ply")["roughness"], 0.9)
    scene = opened(tmp_path / "a.blend")
    assert folder_of(collection()) == edited and scene.refgs.runs[0].folder == str(edited)
    light = scene.world[RECOVERED]
    assert bpy.path.abspath(light.filepath) == str(edited / "environment.exr") and light.packed_file


def test_a_light_that_an_earlier_release_did_not_pack_comes_back(edited, addon, tmp_path):
    light = bpy.context.scene.world[RECOVERED]
    light.unpack(method="REMOVE")
    scene = opened(tmp_path / "a.blend")
    for lit in (match_light, lambda scene: relight(scene, None)):
        with pytest.raises(InputError, match=r"environment\.exr does not exist: press Find Run Folder"):
            lit(scene)
    find_run(Path(collection()[FOLDER]), edited)
    match_light(scene)
    assert scene.world[RECOVERED].packed_file


def test_a_missing_hdri_is_said_in_one_line(edited, addon, tmp_path):
    (tmp_path / "hdri.exr").unlink()
    scene = opened(tmp_path / "a.blend")
    with pytest.raises(InputError, match=r"hdri\.exr does not exist: choose the HDRI again"):
        match_light(scene)


def test_another_run_is_not_taken_for_it(edited, addon, tmp_path):
    for name, spoil, says in (
        ("other", lambda path: write_ply(path, random_columns(seed=1)), "is another run"),
        ("fewer", lambda path: write_ply(path, random_columns(3)), "is another run"),
        ("none", lambda path: path.unlink(), "is not a run"),
    ):
        spoil(write_run(tmp_path / name) / "splats.ply")
        before = collection()[FOLDER]
        with pytest.raises(InputError, match=says):
            find_run(Path(before), tmp_path / name)
        assert collection()[FOLDER] == before


def test_a_copy_is_chosen_though_the_original_is_there(run_folder, addon, tmp_path):
    """Check that nothing points to the original afterwards: resuming the run would write there."""
    run, known = import_run(run_folder, addon), addon.refgs.runs.add()
    known.folder = str(run_folder)
    copied = shutil.copytree(run_folder, tmp_path / "copy" / "pot")
    find_run(run_folder, copied)
    assert run.collection[FOLDER] == known.folder == str(copied)
    assert run.world[RECOVERED].filepath == str(copied / "environment.exr")


def test_a_stopped_training_is_found_too(addon, tmp_path):
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "run.toml").touch()
    known = addon.refgs.runs.add()
    known.folder = str(tmp_path / "old")
    bpy.ops.refgs.find_run(folder=known.folder, directory=str(tmp_path / "new"))
    assert known.folder == str(tmp_path / "new") and jobs.run_state(Path(known.folder)) == "stopped"


def test_what_moved_with_the_run_is_found_too(run_folder, addon, tmp_path):
    """Check that the photos and the other runs of a moved project are found, and that what did not move stays."""
    photos, scene = tmp_path / "photos", addon
    for folder in (photos, tmp_path / "stays", tmp_path / "pot 2"):
        folder.mkdir()
    (run_folder / "run.toml").write_text(f"[run]\ncapture = {json.dumps(str(photos))}\n")
    frames = [frame | {"photo": "front.png"} for frame in FRAMES]
    (run_folder / "cameras.json").write_text(json.dumps({"frames": frames}))
    shutil.copyfile(bpy.path.abspath(write_picture(tmp_path)), photos / "front.png")
    run = import_run(run_folder, scene)
    scene.refgs.capture, scene.refgs.out = str(photos), str(tmp_path / "stays")
    for name in ("pot", "pot 2"):
        known = scene.refgs.runs.add()
        known.folder, known.capture = str(tmp_path / name), str(photos)
    to = tmp_path / "elsewhere"
    to.mkdir()
    for name in ("pot", "pot 2", "photos"):
        os.rename(tmp_path / name, to / name)
    find_run(run_folder, to / "pot")
    assert [(known.folder, known.capture) for known in scene.refgs.runs] == [
        (str(to / name), str(to / "photos")) for name in ("pot", "pot 2")
    ]
    assert (scene.refgs.capture, scene.refgs.out) == (str(to / "photos"), str(tmp_path / "stays"))
    assert {camera.data["refgs_photo"] for camera in run.cameras.values()} == {str(to / "photos" / "front.png")}


def write_picture(folder):
    """Write a small PNG, and return its path."""
    image = bpy.data.images.new("picture", 4, 4)
    image.file_format, image.filepath_raw = "PNG", str(folder / "picture.png")
    image.save()
    bpy.data.images.remove(image)
    return str(folder / "picture.png")
