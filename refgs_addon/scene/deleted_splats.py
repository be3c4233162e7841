"""Delete single splats of a run, such as floaters in the air, and bring them back."""

import bpy

from .. import compat
from ..nodes.kept_tree import NAME, kept_tree
from .run_parts import stand_with


def add_points(splats: bpy.types.Object) -> bpy.types.Object:
    """Add a mesh with a vertex at each splat, or return the existing one. A splat is not drawn if its vertex is deleted from this mesh.

    The artist selects and deletes vertices with Blender's own tools, in Edit Mode. `splats` is the object of the run's point cloud.
    """
    if (points := points_of(splats)) is not None:
        return points
    mesh = bpy.data.meshes.new(f"{splats.name} to delete")
    mesh.vertices.add(len(splats.data.points))
    places = [0.0] * (3 * len(splats.data.points))
    splats.data.attributes["position"].data.foreach_get("vector", places)
    mesh.vertices.foreach_set("co", places)
    points = bpy.data.objects.new(mesh.name, mesh)
    points.hide_render = True  # and not shown in front: all points together would cover the object
    stand_with(points, splats)
    splats.users_collection[0].objects.link(points)
    modifier = splats.modifiers.get(NAME) or splats.modifiers.new(NAME, "NODES")
    modifier.node_group = kept_tree()
    splats.modifiers.move(splats.modifiers.find(NAME), 0)  # edits of materials see what is left
    bpy.context.view_layer.update()  # 5.2 creates the modifier's inputs here
    compat.set_modifier_input(modifier, "Points", points)
    return points


def points_of(splats: bpy.types.Object) -> bpy.types.Object | None:
    """Find the mesh that `add_points` has made, or return None if there is none."""
    modifier = splats.modifiers.get(NAME)
    return compat.get_modifier_input(modifier, "Points") if modifier else None


def count_deleted(splats: bpy.types.Object) -> int:
    """Count the splats that were deleted."""
    points = points_of(splats)
    if points is None:
        return 0
    points.update_from_editmode()
    return len(splats.data.points) - len(points.data.vertices)


def restore(splats: bpy.types.Object) -> None:
    """Bring all deleted splats back."""
    if (points := points_of(splats)) is not None:
        bpy.data.meshes.remove(points.data)  # and the object with it
    if NAME in splats.modifiers:
        splats.modifiers.remove(splats.modifiers[NAME])
