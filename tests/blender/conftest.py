"""Provide Blender, as a Python module, to the tests. A process has one file, so each test starts with an empty one."""

import pytest

from tests.makers.runs import write_run

bpy = pytest.importorskip("bpy", reason="needs Blender's Python module")


@pytest.fixture
def run_folder(tmp_path):
    return write_run(tmp_path / "pot")


@pytest.fixture
def scene():
    """Open an empty file, and return its scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return bpy.context.scene
