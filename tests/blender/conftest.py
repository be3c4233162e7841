"""Provide Blender, as a Python module, to the tests. A process has one file, so each test starts with an empty one."""

import pytest

from tests.makers.runs import write_run

bpy = pytest.importorskip("bpy", reason="needs Blender's Python module")


@pytest.fixture
def run_folder(tmp_path):
    """Write a run folder named pot; return its path."""
    return write_run(tmp_path / "pot")


@pytest.fixture
def scene():
    """Open an empty file, and return its scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return bpy.context.scene


@pytest.fixture
def run(run_folder, scene):
    """Import the run folder into the scene."""
    from refgs_addon.scene.import_run import import_run

    return import_run(run_folder, scene)


@pytest.fixture
def addon(scene):
    """Enable the add-on, and return the scene of an empty file."""
    from refgs_addon import preferences, ui

    enabled = bpy.context.preferences.addons.new()
    enabled.module = preferences.PACKAGE
    ui.register()
    yield scene
    ui.unregister()
    bpy.context.preferences.addons.remove(enabled)
