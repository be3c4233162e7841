"""Add a turntable: a run rotates once about itself, while the camera and the environment stand still."""

import math

import bpy

from .. import compat
from ..errors import InputError
from .run_parts import parts, root

KEY = "refgs_turntable"  # custom property of the Empty that rotates


def add_turntable(scene: bpy.types.Scene, collection: bpy.types.Collection) -> bpy.types.Object:
    """Make a run rotate once about itself in the scene's frame range, by parenting its objects to a rotating Empty. Returns the Empty.

    The full turn is reached one frame after the last frame, so that a loop does not pause.
    Raises InputError if the run has a turntable already.
    """
    found = parts(collection)
    if not found:
        raise InputError(f"{collection.name} is not an imported run: import one first")
    if any(KEY in item for item in collection.objects):
        raise InputError(f"{collection.name} is on a turntable already: delete its Empty to remove it")
    base = root(collection)
    items = [item for item in collection.objects if item != base and item.parent == base]
    low, high = (
        [f(corner[axis] for item in found["splats"] for corner in item.bound_box) for axis in range(3)]
        for f in (min, max)
    )
    table = bpy.data.objects.new(f"{collection.name} turntable", None)
    table[KEY] = True
    table.empty_display_type = "CIRCLE"
    table.empty_display_size = 0.6 * max(b - a for a, b in zip(low, high, strict=True))
    table.location = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
    collection.objects.link(table)
    for frame, turn in ((scene.frame_start, 0.0), (scene.frame_end + 1, 2 * math.pi)):
        table.rotation_euler = 0.0, 0.0, turn
        table.keyframe_insert("rotation_euler", index=2, frame=frame)
    for curve in compat.fcurves(table):
        for key in curve.keyframe_points:
            key.interpolation = "LINEAR"
        curve.extrapolation = "LINEAR"
    table.rotation_euler = 0.0, 0.0, 0.0
    table.parent, table.matrix_parent_inverse = base, found["splats"][0].matrix_parent_inverse
    for item in items:
        item.parent, item.matrix_parent_inverse = table, table.matrix_basis.inverted()
    return table
