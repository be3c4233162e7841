"""Test that the paths in a .blend are relative to it, so that a copied project works in its own folders."""

import json
import shutil

import bpy
import pytest

from refgs_addon.scene.camera_objects import show_photo
from refgs_addon.scene.export_run import run_folder as folder_of
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.run_parts import FOLDER
from tests.makers.runs import write_run


@pytest.fixture
def project(addon, tmp_path):
    """Make a project of a .blend, a run and its capture in one folder, and return the folder. The .blend is open."""
    top = tmp_path / "project"
    for name in ("runs", "photos"):
        (top / name).mkdir(parents=True)
    folder = write_run(top / "runs" / "pot")

    (folder / "run.toml").write_text(f"[run]\ncapture = {json.dumps(str(top / 'photos'))}\n")
    data = json.loads((folder / "cameras.json").read_text())
    for frame in data["frames"]:
        frame["photo"], frame["mask"] = "images/0001.jpg", "mask/0001.png"
    (folder / "cameras.json").write_text(json.dumps(data))
    import_run(folder, addon)
    addon.refgs.capture, addon.refgs.out = str(top / "photos"), ""
    known = addon.refgs.runs.add()
    known.folder, known.capture = str(folder), str(top / "photos")
    bpy.ops.wm.save_as_mainfile(filepath=str(top / "scene.blend"))
    return top


def stored() -> dict[str, str]:
    """Return the paths that the add-on stores in the open file."""
    (collection,) = (item for item in bpy.data.collections if FOLDER in item)
    settings = bpy.context.scene.refgs
    return {
        "run": collection[FOLDER],
        "photo": bpy.data.cameras[0]["refgs_photo"],
        "mask": bpy.data.cameras[0]["refgs_mask"],
        "capture": settings.capture,
        "out": settings.out,
        "known": settings.runs[0].folder,
        "trained": settings.runs[0].capture,
    }


def expected(top) -> dict[str, str]:
    photos, run = str(top / "photos"), str(top / "runs" / "pot")
    photo = str(top / "photos" / "images" / "0001.jpg")
    mask = str(top / "photos" / "mask" / "0001.png")
    return {"run": run, "photo": photo, "mask": mask, "capture": photos, "out": "", "known": run, "trained": photos}


def test_a_copied_project_works_in_its_own_run(project, tmp_path):
    assert stored() == expected(project)  # absolute while it is open
    copied = shutil.copytree(project, tmp_path / "elsewhere" / "copy")
    bpy.ops.wm.open_mainfile(filepath=str(copied / "scene.blend"))
    assert stored() == expected(copied)
    assert folder_of(next(item for item in bpy.data.collections if FOLDER in item)) == copied / "runs" / "pot"
    shutil.rmtree(copied)
    bpy.ops.wm.open_mainfile(filepath=str(project / "scene.blend"))
    assert stored() == expected(project)


def test_paths_in_the_file_are_relative(project):
    from refgs_addon import blend_paths

    blend_paths.unregister()
    bpy.ops.wm.open_mainfile(filepath=str(project / "scene.blend"))
    found = stored()
    blend_paths.register()
    assert found["run"] == "//runs/pot" and found["capture"] == found["trained"] == "//photos"
    assert found["mask"] == "//photos/mask/0001.png"
    assert found["photo"] == "//photos/images/0001.jpg" and found["known"] == "//runs/pot"


def test_the_light_of_a_run_that_was_imported_later_is_relative(project, tmp_path):
    write_run(project / "runs" / "vase")
    run = import_run(project / "runs" / "vase", bpy.context.scene)
    (image,) = (
        image for image in bpy.data.images if image.filepath == str(project / "runs" / "vase" / "environment.exr")
    )
    bpy.ops.wm.save_mainfile()
    assert image.filepath == "//runs/vase/environment.exr" and run.collection[FOLDER] == str(project / "runs" / "vase")
    (tmp_path / "else").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "else" / "a.blend"))
    assert image.filepath == "//../project/runs/vase/environment.exr"


@pytest.mark.parametrize("by", ["link", "place"])
def test_a_project_behind_a_symbolic_link_is_copied_whole(project, tmp_path, by):
    """Check that a copy does not work in the original's run where the run was imported by another path than the .blend was opened."""
    link = tmp_path / "link"
    link.symlink_to(project)
    write_run(project / "runs" / "vase")
    top, other = (link, project) if by == "link" else (project, link)
    bpy.ops.wm.open_mainfile(filepath=str(top / "scene.blend"))
    for path in (top, other):
        import_run(path / "runs" / "vase", bpy.context.scene)
    bpy.ops.wm.save_mainfile()
    copied = shutil.copytree(project, tmp_path / "elsewhere" / "deep" / "copy")
    bpy.ops.wm.open_mainfile(filepath=str(copied / "scene.blend"))
    folders = [item[FOLDER] for item in bpy.data.collections if FOLDER in item]
    assert folders == [str(copied / "runs" / name) for name in ("pot", "vase", "vase")]


def test_a_photo_that_was_shown_later_is_relative(project):
    camera = next(item for item in bpy.data.objects if item.type == "CAMERA")
    photo = project / "photos" / "images" / "0001.jpg"
    photo.parent.mkdir()
    image = bpy.data.images.new("photo", 4, 4)
    image.file_format, image.filepath_raw = "JPEG", str(photo)
    image.save()
    bpy.data.images.remove(image)
    show_photo(camera)
    bpy.ops.wm.save_mainfile()
    assert camera.data.background_images[0].image.filepath == "//photos/images/0001.jpg"


def test_saving_elsewhere_keeps_the_run(project, tmp_path):
    (tmp_path / "else" / "deep").mkdir(parents=True)
    bpy.context.scene.refgs.out = "//runs/next"  # typed
    for copy in (True, False):
        file = tmp_path / "else" / "deep" / f"{copy}.blend"
        bpy.ops.wm.save_as_mainfile(filepath=str(file), copy=copy)
        assert stored() == expected(project) | {"out": str(project / "runs" / "next")}
    for copy in (True, False):
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "else" / "deep" / f"{copy}.blend"))
        assert stored() == expected(project) | {"out": str(project / "runs" / "next")}


def test_what_is_appended_to_another_file_keeps_its_run(project, tmp_path):
    (tmp_path / "other").mkdir()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "other" / "b.blend"))
    bpy.ops.wm.append(filename="RefGS pot", directory=str(project / "scene.blend" / "Collection") + "/")
    (collection,) = (item for item in bpy.data.collections if FOLDER in item)
    assert collection[FOLDER] == str(project / "runs" / "pot")
    assert {camera["refgs_photo"] for camera in bpy.data.cameras} == {expected(project)["photo"]}
