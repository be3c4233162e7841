"""Test Train Many in Blender: the table that a batch writes, its start and stop, and the library of assets made of its runs."""

import json
import os
import shutil
import sys
from pathlib import Path

import bpy
import pytest
from filelock import FileLock

from refgs_addon import jobs
from refgs_addon.errors import InputError
from refgs_addon.scene import asset_library
from refgs_addon.scene.run_parts import CAMERAS, parts
from refgs_addon.trainer import preferences
from refgs_addon.trainer.scene import batch_assets, batch_table, many
from tests.makers.runs import write_run
from tests.makers.training import TINY
from tests.makers.waiting import final_state, until


def row(name, state="done", **facts):
    """Make a row as `refgs batch` writes it."""
    known = {"capture": f"/photos/{name}", "seconds": 90.0, "what": "", "log": None, "step": "", "part": None}
    return {"name": name, "state": state} | known | {"figures": {"psnr": 31.25}, "picture": None} | facts


def write_table(folder, *rows):
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    (folder / "logs" / "rows.json").write_text(json.dumps({"rows": rows}))


@pytest.fixture
def results(addon, tmp_path):
    """Choose a folder of captures, and a folder that has the table of a batch. Return the latter."""
    (tmp_path / "shelf").mkdir()
    addon.refgs.many.captures, addon.refgs.many.results = str(tmp_path / "shelf"), f"{tmp_path / 'runs'}/"
    failed = row("cup", "failed", what="train: a photo is broken", log=str(tmp_path / "cup.log"))
    write_table(
        tmp_path / "runs", row("pot"), failed, row("jar", "running", step="train", part=0.42), row("can", "waiting")
    )
    return tmp_path / "runs"


def test_rows_say_how_far_runs_are(results):
    with FileLock(results / "logs" / "run.lock"):
        found = {row.name: (row.state, row.words) for row in batch_table.read_rows(results)}
    assert found == {
        "pot": ("done", "31.2 dB, 1.5 min"),
        "cup": ("failed", "failed"),
        "jar": ("running", "training, 42%"),
        "can": ("waiting", "waiting"),
    }


@pytest.mark.parametrize("typed", [True, False])
def test_a_copied_file_does_not_continue_the_originals_batch(addon, results, tmp_path, typed):
    if not typed:
        addon.refgs.many.results = ""
        (tmp_path / "shelf RefGS").mkdir()
    (tmp_path / "a").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a" / "a.blend"))
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "b" / "a.blend"))
    with pytest.raises(InputError, match="of which this file is a copy"):
        many.train_many(bpy.context.scene)


def test_what_a_killed_batch_left_is_stopped(results):
    assert [row.state for row in batch_table.read_rows(results)] == ["done", "failed", "stopped", "stopped"]


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"rows": 3}', '{"rows": [3, {"name": "a"}, {"name": "b", "state": null}]}']
)
def test_a_damaged_table_has_no_rows(tmp_path, text):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "rows.json").write_text(text)
    assert batch_table.read_rows(tmp_path) == []


def test_a_damaged_row_is_left_out(tmp_path):
    write_table(tmp_path, row("bad", seconds="soon"), row("good", figures={}), row("odd", "running", step="x", part=[]))
    assert [(row.name, row.words) for row in batch_table.read_rows(tmp_path)] == [
        ("good", "1.5 min"),
        ("odd", "stopped"),
    ]


def test_the_list_follows_the_file_and_keeps_what_is_selected(results):
    manager = bpy.context.window_manager
    assert batch_table.show_table(results) and not batch_table.show_table(results)
    manager.refgs_row = 1
    assert batch_table.chosen_row(results).what == "train: a photo is broken"
    write_table(results, row("a new one", "waiting"), row("pot"), row("cup"))
    os.utime(results / "logs" / "rows.json", (1e9, 1e9))
    assert batch_table.show_table(results)
    assert [item.name for item in manager.refgs_rows] == ["a new one", "pot", "cup"]
    assert batch_table.chosen_row(results).name == "cup" and batch_table.chosen_row(results.parent) is None
    assert batch_table.show_table(results.parent) and not manager.refgs_rows


@pytest.mark.usefixtures("fake_trainer")
def test_the_button_asks_the_trainer_for_a_batch(addon, tmp_path):
    assert not bpy.ops.refgs.train_many.poll()
    with pytest.raises(InputError, match="no captures are chosen"):
        many.train_many(addon)
    addon.refgs.many.captures = str(tmp_path / "shelf")
    with pytest.raises(InputError, match="does not exist"):
        many.train_many(addon)
    (tmp_path / "shelf").mkdir()
    assert bpy.ops.refgs.train_many() == {"FINISHED"}
    job, out = jobs.JOBS[-1], tmp_path / "shelf RefGS"
    asked = {"command": "batch", "captures": str(tmp_path / "shelf"), "out": str(out), "preset": "quick"}
    assert job.commands == [asked] and job.run == out / "logs" and jobs.trainings() == [job]
    with pytest.raises(InputError, match="being trained into it already"):
        many.train_many(addon)
    with pytest.raises(RuntimeError, match="no run has finished"):
        bpy.ops.refgs.import_as_assets()


@pytest.fixture
def finished(results):
    """Write the runs of a batch, two of which have ended. Return the folder."""
    for name in ("pot", "jar"):
        write_run(results / name)
    (results / "jar" / "splats.ply").write_bytes(b"ply\n")
    picture = results / "pot.png"
    image = bpy.data.images.new("pot", 64, 32)
    image.generated_color = 1, 0, 0, 1
    image.filepath_raw, image.file_format = str(picture), "PNG"
    image.save()
    write_table(results, row("pot", picture=str(picture)), row("jar"), row("cup", "failed"))
    return results


def test_finished_runs_become_assets_of_a_library(finished):
    libraries = bpy.context.preferences.filepaths.asset_libraries
    before = len(libraries)
    objects = set(bpy.data.objects)
    assert bpy.ops.refgs.import_as_assets() == {"FINISHED"}
    job = jobs.JOBS[-1]
    assert job.state == "done", (job.line, job.log.read_text())
    made = job.results["library"]
    assert made["written"] == 1 and len(made["failed"]) == 1
    assert made["failed"][0].startswith("jar: ") and "splats.ply" in made["failed"][0]
    assert set(bpy.data.objects) == objects
    library = finished / "library"
    assert [Path(known.path) for known in libraries[before:]] == [library]
    assert {file.name for file in library.iterdir()} == {"blender_assets.cats.txt", "pot.blend"}
    assert f"{asset_library.CATALOG_ID}:RefGS:RefGS\n" in (library / "blender_assets.cats.txt").read_text()
    assert [row.name for row in batch_assets.missing_assets(finished)] == ["jar"]

    with bpy.data.libraries.load(str(library / "pot.blend"), assets_only=True) as (found, wanted):
        wanted.collections = found.collections
    assert tuple(bpy.data.collections["RefGS pot"].preview.image_size) > (0, 0)
    asset_library.add_library(finished)
    assert len(libraries) == before + 1
    written = (library / "pot.blend").read_bytes()
    bpy.ops.refgs.import_as_assets()
    assert (library / "pot.blend").read_bytes() == written
    libraries.remove(libraries[-1])


def test_an_asset_is_loaded_with_its_textures(finished):
    """Write an asset, read it into an empty file, and check its parts, its preview, and that no other file is needed."""
    mesh = finished / "pot" / "mesh.glb"
    shutil.copyfile(textured_mesh(finished), mesh)
    file = finished / "library" / "pot.blend"
    file.parent.mkdir()
    asset_library.write_asset(finished / "pot", finished / "pot.png", file)
    shutil.rmtree(finished / "pot")
    (finished / "pot.png").unlink()
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    with bpy.data.libraries.load(str(file), assets_only=True) as (found, wanted):
        assert found.collections == ["RefGS pot"] and not found.objects
        wanted.collections = found.collections
    collection = bpy.data.collections["RefGS pot"]
    assert collection.asset_data.catalog_id == asset_library.CATALOG_ID
    pixels = collection.preview.image_pixels_float[:]
    assert pixels[0] > 0.9 and pixels[1] < 0.1
    assert {key: len(items) for key, items in parts(collection).items()} == {"splats": 1, "mesh": 1}
    assert not any(CAMERAS in child for child in bpy.data.collections) and not bpy.data.cameras
    images = [image for image in bpy.data.images if image.source == "FILE"]
    assert images and all(image.packed_file and min(image.size) for image in images)
    drawn = parts(collection)["mesh"][0].data.materials[0].node_tree
    assert any(node.type == "TEX_IMAGE" and tuple(node.image.pixels[:3]) == (0.0, 1.0, 0.0) for node in drawn.nodes)


def textured_mesh(folder):
    """Write a GLB of a plane with a green texture, and return its path."""
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    bpy.ops.mesh.primitive_plane_add()
    material = bpy.data.materials.new("green")
    material.use_nodes = True
    image = bpy.data.images.new("green", 8, 8)
    image.generated_color = 0, 1, 0, 1
    node = material.node_tree.nodes.new("ShaderNodeTexImage")
    node.image = image
    shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    material.node_tree.links.new(node.outputs["Color"], shader.inputs["Base Color"])
    bpy.context.object.data.materials.append(material)
    bpy.ops.export_scene.gltf(filepath=str(folder / "green.glb"))
    return folder / "green.glb"


def test_catalogs_of_the_artist_stay(tmp_path):
    file = tmp_path / "blender_assets.cats.txt"
    file.write_text("VERSION 1\n\n11111111-6a0c-4c34-9b59-4f0c3d3b7c21:Props:Props")
    for _ in range(2):
        asset_library.add_catalog(tmp_path)
    lines = file.read_text().splitlines()
    assert lines[2].endswith(":Props") and lines[3] == f"{asset_library.CATALOG_ID}:RefGS:RefGS" and len(lines) == 4


@pytest.mark.slow
def test_a_small_batch_is_stopped_and_resumed(addon, ball_capture, tmp_path):
    """Train a list of captures by the real trainer and Ray, stop it, and press the button again."""
    pytest.importorskip("ray")
    for name in ("ball", "broken"):
        shutil.copytree(ball_capture, tmp_path / "shelf" / name)
    next((tmp_path / "shelf" / "broken").rglob("*.png")).write_bytes(b"no picture")
    changes = [*TINY, "environment.resolution=16", "train.iterations=1500", "mesh.resolution=32", "mesh.texture=64"]
    captures = "".join(f'[[captures]]\nfolder = "shelf/{name}"\n' for name in ("ball", "broken"))
    (tmp_path / "list.toml").write_text(f"set = {json.dumps(changes)}\n{captures}")
    preferences.preferences().python = sys.executable
    addon.refgs.many.captures, addon.refgs.many.results = str(tmp_path / "list.toml"), str(tmp_path / "runs")
    job = many.train_many(addon)
    until(lambda: (tmp_path / "runs" / "ball" / "progress.json").exists(), 240)
    assert jobs.run_state(job.run) == "training"
    job.stop()
    assert final_state(job, 240) == "cancelled", job.line
    states = {row.name: row.state for row in batch_table.read_rows(tmp_path / "runs")}
    assert states["ball"] == "stopped" and list((tmp_path / "runs" / "ball" / "checkpoints").iterdir())
    again = many.train_many(addon)
    assert final_state(again, 240) == "done", again.line
    assert job not in jobs.JOBS and again.results["batch"]["failed"] == 1
    rows = {row.name: row for row in batch_table.read_rows(tmp_path / "runs")}
    assert rows["ball"].state == "done" and "dB" in rows["ball"].words and Path(rows["ball"].picture).is_file()
    assert (
        rows["broken"].state == "failed"
        and "not an image" in rows["broken"].what
        and Path(rows["broken"].log).is_file()
    )


def test_only_logs_and_pictures_of_the_batch_are_opened(tmp_path):
    """Check that a table that came with a folder cannot make *Open Log* run a program."""
    runs, logs = tmp_path / "runs", tmp_path / "runs" / "logs" / "cup"
    logs.mkdir(parents=True)
    for file in (logs / "train.log", logs / "train.bat", tmp_path / "other.log", runs / "a.png"):
        file.write_text("text")
    (runs / "link.log").symlink_to(tmp_path / "other.log")
    asked = [
        logs / "train.log",
        logs / "train.bat",
        tmp_path / "other.log",
        runs / "link.log",
        runs / ".." / "other.log",
    ]
    asked += [runs / "gone.log", "//server/a.log", "https://example.org/a.log", runs]
    write_table(runs, *(row(str(i), "failed", log=str(log), picture=str(log)) for i, log in enumerate(asked)))
    found = batch_table.read_rows(runs)
    assert [one.log for one in found] == [str(asked[0]), *[""] * (len(asked) - 1)]
    assert {one.picture for one in found} == {""}
    write_table(runs, row("cup", picture=str(runs / "a.png"), log=str(runs / "a.png")))
    assert [(one.picture, one.log) for one in batch_table.read_rows(runs)] == [(str(runs / "a.png"), "")]
