"""Add and read regions: Empties that mark a part of space. They mark what to edit, what to draw, or what to train."""

import bpy
from mathutils import Vector

from .. import compat
from ..nodes.splats_tree import NAME

REGION = "refgs_region"  # custom property of an object that marks a region


def add_region(splats: bpy.types.Object, collection: bpy.types.Collection, name: str, shape: str) -> bpy.types.Object:
    """Add an Empty around the splats. In the Empty's local coordinates, nearly all splats lie in the cube from -1 to 1.

    `shape` is how Blender displays the Empty: "CUBE", "SPHERE" or "ARROWS". It is drawn in front of the object that surrounds it.
    """
    region = bpy.data.objects.new(name, None)
    region[REGION] = region.show_in_front = True
    region.empty_display_type = shape
    low, high = bounds(splats.data)
    region.parent, region.matrix_parent_inverse = splats.parent, splats.matrix_parent_inverse
    region.location = splats.matrix_basis @ ((low + high) / 2)
    region.scale = [side / 2 or 1.0 for side in high - low]
    collection.objects.link(region)
    return region


def bounds(cloud: bpy.types.PointCloud) -> tuple[Vector, Vector]:
    """Return a point cloud's lowest and highest corner without 2 % of points per side."""
    import numpy as np  # Debian's Blender may lack it

    places = np.empty((len(cloud.points), 3), np.float32)
    cloud.attributes["position"].data.foreach_get("vector", places.ravel())
    ends = [int(part * (len(places) - 1)) for part in (0.02, 0.98)]
    low, high = np.partition(places, ends, axis=0)[ends].tolist()
    return Vector(low), Vector(high)


def crop(splats: bpy.types.Object, collection: bpy.types.Collection, on: bool) -> bpy.types.Object | None:
    """Switch cropping on or off, and return the crop box, if any. With `on`, only the splats in the box are drawn.

    The box is made when it is first needed, and is kept when cropping is switched off.
    """
    modifier = splats.modifiers[NAME]
    box = compat.get_modifier_input(modifier, "Crop Box")
    if on and box is None:
        box = add_region(splats, collection, f"Crop of {splats.name}", "CUBE")
        compat.set_modifier_input(modifier, "Crop Box", box)
    compat.set_modifier_input(modifier, "Crop", on)
    if box is not None:
        box.hide_viewport = not on
    return box


def training_region(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """Find the box that limits what is trained, or return None if there is none."""
    box = scene.refgs.region
    return box if box is not None and scene in box.users_scene else None
