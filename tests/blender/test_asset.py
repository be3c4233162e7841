"""Test that a run becomes an asset with a picture of it, and that other objects stay out of the picture."""

import bpy
import numpy as np
import pytest

from refgs_addon.errors import InputError
from refgs_addon.scene.asset import SIDE, mark_asset
from refgs_addon.scene.import_run import import_run
from tests.makers.captures import look_at


def test_an_asset_has_a_picture_of_the_run_alone(run, scene):
    scene.eevee.use_raytracing = False  # much faster in software
    camera = run.cameras["front"]
    camera.matrix_world = [*zip(*look_at([1.0, -7.0, 2.5], [1.0, -3.0, 2.0]), strict=True)]
    bpy.ops.mesh.primitive_cube_add(size=3, location=(1, -3, 2))
    before = scene.camera, scene.world
    mark_asset(scene, run.collection)
    assert (scene.camera, scene.world) == before and list(bpy.data.scenes) == [scene]
    assert run.collection.asset_data is not None
    pixels = np.array(run.collection.preview.image_pixels_float).reshape(SIDE, SIDE, 4)
    part = (pixels[..., 3] > 0.5).mean()
    assert 0.001 < part < 0.2  # the box; the cube would fill half of the picture


def test_without_a_camera_it_says_so(run_folder, scene):
    (run_folder / "cameras.json").unlink()
    run = import_run(run_folder, scene)
    with pytest.raises(InputError, match="no camera"):
        mark_asset(scene, run.collection)
    assert run.collection.asset_data is None


def test_the_button_marks_the_run(run_folder, addon):
    bpy.ops.refgs.import_run(directory=f"{run_folder}/")
    bpy.ops.refgs.mark_asset()
    assert bpy.data.collections["RefGS pot"].asset_data is not None
