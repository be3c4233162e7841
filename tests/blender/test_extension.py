"""Test that the extension registers, that Blender's own tool builds and validates it, and that its buttons work."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from refgs_addon import ui
from refgs_addon.ui import operators
from tests.makers.runs import COUNT, write_panorama

ROOT = Path(__file__).resolve().parents[2]
TOOL = Path(bpy.utils.resource_path("LOCAL"), "scripts", "addons_core", "bl_pkg", "cli", "blender_ext.py")
# Files of a clone that do not belong into the extension's zip.
LEFT = [
    "refgs_addon/__pycache__/jobs.pyc", "refgs_addon/ui/__pycache__/a.pyc", "refgs_addon/jobs.pyc", "refgs_addon/.DS_Store",
    "run/splats.ply", "refgs/a", "reference/a.jpg", "refgs_runs/a", "refgs_addon.zip", "_out/a", "LOG.txt", "white ball/a.jpg",
    "r", "d/a", "dist/a.zip", "demo/run/a", "do/a", "docs.zip", "docs2/a.md", "doc/a.md", "wood/b", ".venv/c",
]  # fmt: skip


def test_registers_and_unregisters_twice(scene):
    def ours():
        return {name for name in dir(bpy.types) if "refgs" in name.lower()} | set(dir(bpy.ops.refgs))

    before = ours()
    for _ in range(2):
        ui.register()
        assert bpy.types.REFGS_PT_run.bl_category == "RefGS" and "import_run" in dir(bpy.ops.refgs)
        ui.unregister()
        assert ours() == before


def test_registers_and_draws_without_numpy():
    """Check that the add-on registers without numpy, which Debian's Blender may lack.

    The panel then shows no curve of the training's progress.
    """
    code = """if True:
        import sys
        sys.modules["numpy"] = None
        from types import SimpleNamespace
        import bpy
        from refgs_addon.trainer.ui import job_icons
        from tests.makers import extension
        extension.list_in_preferences()
        extension.enable()
        job = SimpleNamespace(serial=1, curve=[(1.0, 20.0), (2.0, 21.0)], held_out=[])
        assert job_icons.curve_icon(job) == 0
        extension.disable()
        print("registered")
    """
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert "registered" in done.stdout, done.stderr


def test_builds_and_validates(tmp_path):
    """Check that the built zip holds the extension only, though the repository's folder also holds runs and captures."""
    clone, archive = tmp_path / "refgs", tmp_path / "refgs.zip"
    for folder in ("refgs_addon", "docs"):
        shutil.copytree(ROOT / folder, clone / folder)
    for name in ("__init__.py", "blender_manifest.toml", "LICENSE", "README.md"):
        shutil.copy(ROOT / name, clone)
    for left in LEFT:
        (clone / left).parent.mkdir(parents=True, exist_ok=True)
        (clone / left).touch()
    for arguments in (["build", "--source-dir", clone, "--output-filepath", archive], ["validate", archive]):
        done = subprocess.run([sys.executable, TOOL, *arguments], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    code = {str(path.relative_to(ROOT)) for path in (ROOT / "refgs_addon").rglob("*.py")}
    code = {name for name in code if not name.startswith(("refgs_addon/trainer/", "refgs_addon/preview"))}
    code |= {str(path.relative_to(ROOT)) for path in (ROOT / "refgs_addon" / "example").rglob("*") if path.is_file()}
    pages = {f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")}
    assert set(zipfile.ZipFile(archive).namelist()) == code | pages | {
        "__init__.py",
        "blender_manifest.toml",
        "LICENSE",
    }


def test_the_buttons(run_folder, addon, tmp_path):
    assert bpy.ops.refgs.import_run(directory=f"{run_folder}/") == {"FINISHED"}
    splats, mesh = bpy.data.objects["pot splats"], bpy.data.objects["pot mesh"]
    assert len(splats.data.points) == COUNT
    bpy.ops.refgs.show(collection="RefGS pot", part="mesh")
    assert splats.hide_viewport and not mesh.hide_viewport
    write_panorama(tmp_path / "hdri.exr", np.ones((8, 16, 3)))
    bpy.ops.refgs.relight(filepath=str(tmp_path / "hdri.exr"), rotation=1.0, strength=3.0)
    nodes = addon.world.node_tree.nodes
    assert nodes["RefGS HDRI"].image.name == "hdri.exr"
    assert nodes["RefGS Strength"].inputs["Strength"].default_value == 3.0
    bpy.ops.refgs.recovered_light()
    assert nodes["RefGS HDRI"].image.name == "environment.exr"
    bpy.ops.refgs.render_preview(filepath=str(tmp_path / "a.png"), size=16, samples=1)
    assert (tmp_path / "a.png").stat().st_size > 0


def test_the_manual_is_opened_from_disk(addon, monkeypatch, tmp_path):
    opened = []
    monkeypatch.setattr(bpy.ops, "wm", SimpleNamespace(path_open=lambda filepath: opened.append(filepath)))
    assert bpy.ops.refgs.open_manual() == {"FINISHED"}
    assert opened == [str(ROOT / "docs" / "blender.md")]
    monkeypatch.setattr(operators, "MANUAL", tmp_path / "blender.md")
    with pytest.raises(RuntimeError, match=r"blender\.md does not exist"):
        bpy.ops.refgs.open_manual()


def test_dropped_files_stand_for_their_folders(run_folder, addon, tmp_path):
    (run_folder / "run.toml").write_text("[run]\n")
    bpy.ops.refgs.drop_run(filepath=str(run_folder / "run.toml"))
    assert bpy.data.objects["pot splats"]
    bpy.ops.refgs.drop_capture(filepath=str(tmp_path / "transforms_train.json"))
    assert addon.refgs.capture == str(tmp_path)
    with pytest.raises(RuntimeError, match=r"^Error: settings\.json is not a transforms"):
        bpy.ops.refgs.drop_capture(filepath=str(tmp_path / "settings.json"))


def test_a_broken_folder_is_reported_in_one_line(run_folder, addon):
    (run_folder / "splats.ply").write_bytes(b"ply\n")
    with pytest.raises(RuntimeError, match=r"^Error: .*splats\.ply is not a PLY file[^\n]*\n?$"):
        bpy.ops.refgs.import_run(directory=str(run_folder))
    assert not bpy.data.objects and not bpy.data.collections
