"""Test that a run becomes an asset with a picture of it, and that other objects stay out of the picture."""

from functools import partial

import bpy
import numpy as np
import pytest

from refgs_addon.errors import InputError
from refgs_addon.scene import asset
from refgs_addon.scene.asset import SIDE, mark_asset
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.run_parts import cameras
from tests.makers.captures import look_at


def test_the_button_makes_an_asset_whose_picture_shows_the_run_alone(run_folder, addon, monkeypatch):
    monkeypatch.setattr(asset, "render_preview", partial(asset.render_preview, samples=4))
    bpy.ops.refgs.import_run(directory=f"{run_folder}/")
    collection = bpy.data.collections["RefGS pot"]
    addon.eevee.use_raytracing = addon.eevee.use_shadows = False  # much faster in software
    camera = next(item for item in cameras(collection).objects if item.name.startswith("front"))
    camera.matrix_world = [*zip(*look_at([1.0, -7.0, 2.5], [1.0, -3.0, 2.0]), strict=True)]
    addon.camera = camera
    bpy.ops.mesh.primitive_cube_add(size=3, location=(1, -3, 2))
    before = addon.camera, addon.world
    bpy.ops.refgs.mark_asset()
    assert (addon.camera, addon.world) == before and list(bpy.data.scenes) == [addon]
    assert collection.asset_data is not None
    pixels = np.array(collection.preview.image_pixels_float).reshape(SIDE, SIDE, 4)
    part = (pixels[..., 3] > 0.5).mean()
    assert 0.001 < part < 0.2  # the box; the cube would fill half of the picture


def test_without_a_camera_it_says_so(run_folder, scene):
    (run_folder / "cameras.json").unlink()
    run = import_run(run_folder, scene)
    with pytest.raises(InputError, match="no camera"):
        mark_asset(scene, run.collection)
    assert run.collection.asset_data is None
