"""Find how large an imported run is, and move it beside objects that stand in the same place."""

import bpy
from mathutils import Vector

from .regions import bounds
from .run_parts import parts, root

LARGE = 4.0  # sides of a run, above which an object is a room that the run may stand in
GAP = 0.1  # between a run and the object beside it, as a part of the run's side

Box = tuple[Vector, Vector]  # lowest and highest corner, in world space


def extent(splats: bpy.types.Object, meshes: list[bpy.types.Object]) -> Box:
    """Return the box around an unmoved run: its mesh, or else most of its splats."""
    solid = [item for item in meshes if item.data.polygons]
    return _box(solid) if solid else bounds(splats.data)


def put_beside(collection: bpy.types.Collection, layer: bpy.types.ViewLayer) -> bpy.types.Object | None:
    """Move an imported run along x until it overlaps no other visible mesh object, such as Blender's default cube.

    Call this right after the import. Returns the object that the run now stands beside, or None if the run was not moved. Objects at least
    four times as long as the run count as rooms, in which the run may stand.
    """
    layer.update()
    low, high = extent(parts(collection)["splats"][0], parts(collection).get("mesh", []))
    side, own, beside = max(high - low), {*collection.all_objects}, None
    boxes = {
        item: _box([item]) for item in layer.objects if item not in own and item.type == "MESH" and item.visible_get()
    }
    boxes = {item: box for item, box in boxes.items() if max(box[1] - box[0]) < LARGE * side}
    while True:
        in_place = [
            item
            for item, (start, end) in boxes.items()
            if all(start[i] < high[i] and low[i] < end[i] for i in range(3))
        ]
        if not in_place:
            return beside
        beside = max(in_place, key=lambda item: boxes[item][1].x)
        step = Vector((boxes[beside][1].x + GAP * side - low.x, 0, 0))
        low, high = low + step, high + step
        root(collection).location += step


def _box(items: list[bpy.types.Object]) -> Box:
    """Return the box around objects."""
    corners = [item.matrix_world @ Vector(corner) for item in items for corner in item.bound_box]
    low, high = (Vector(f(corner[axis] for corner in corners) for axis in range(3)) for f in (min, max))
    return low, high
