"""Test the turntable animation: the imported run rotates once, and nothing else moves."""

import math

import bpy
import numpy as np
import pytest

from refgs_addon.errors import InputError
from refgs_addon.scene.edit import add_edit
from refgs_addon.scene.regions import REGION
from refgs_addon.scene.turntable import add_turntable


def matrix(item):
    return np.array(item.matrix_world)


def test_one_turn_about_the_upright(run, scene):
    edit = add_edit(run.collection, "Box")
    region = next(item for item in run.collection.objects if item.get(REGION))
    bpy.context.view_layer.update()
    items = [run.splats, run.mesh[0], region]
    before, camera = list(map(matrix, items)), matrix(scene.camera)
    scene.frame_start, scene.frame_end = 11, 58
    scene.frame_set(11)
    table = add_turntable(scene, run.collection)
    assert (scene.frame_start, scene.frame_end, scene.frame_current) == (11, 58, 11)
    bpy.context.view_layer.update()
    np.testing.assert_allclose(list(map(matrix, items)), before, atol=1e-5)
    angles = []
    for frame in (11, 23, 35, 47):
        scene.frame_set(frame)
        angles.append(table.matrix_world.to_euler().z % (2 * math.pi))
    np.testing.assert_allclose(angles, [0, math.pi / 2, math.pi, 3 * math.pi / 2], atol=1e-4)
    scene.frame_set(23)
    place = matrix(table)[:3, 3]
    bpy.context.view_layer.update()
    for item, was in zip(items, before, strict=True):
        expected = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ (was[:3, 3] - place) + place
        np.testing.assert_allclose(matrix(item)[:3, 3], expected, atol=1e-4)
    np.testing.assert_array_equal(matrix(scene.camera), camera)
    assert edit.node_group is not None
    with pytest.raises(InputError, match="already"):
        add_turntable(scene, run.collection)
