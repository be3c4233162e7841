"""Provide fixtures for tests that run Blender as a Python module (bpy).

A process can have only one file open, so each test starts with an empty one.
"""

import pytest

from tests.makers.runs import write_run

bpy = pytest.importorskip("bpy", reason="needs Blender's Python module")


@pytest.fixture
def run_folder(tmp_path):
    """Write a small run folder (the result of a training) named pot; return its path."""
    return write_run(tmp_path / "pot")


@pytest.fixture
def scene():
    """Open an empty file, and return its scene. It has no shadows, which are most of a frame's time in software."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.eevee.use_shadows = False
    return scene


@pytest.fixture
def run(run_folder, scene):
    """Import the training's result in `run_folder` into the scene, and return the imported run."""
    from refgs_addon.scene.import_run import import_run

    return import_run(run_folder, scene)


@pytest.fixture
def addon(scene):
    """Enable the add-on with its trainer during the test, and return the empty scene."""
    from tests.makers import extension

    entries = extension.list_in_preferences()
    extension.enable()
    yield scene
    extension.disable()
    for entry in entries:
        bpy.context.preferences.addons.remove(entry)


@pytest.fixture
def fake_trainer(addon, python):
    """Select the fake trainer in the preferences."""
    from refgs_addon.trainer import preferences

    preferences.preferences().python = str(python)
