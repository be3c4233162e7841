"""Regions: Empties that say which splats are meant."""

import bpy

from .. import compat
from ..nodes.splats import NAME

REGION = "refgs_region"  # the custom property of what was made to mark a region


def add_region(splats: bpy.types.Object, collection: bpy.types.Collection, name: str, shape: str) -> bpy.types.Object:
    """An Empty, drawn as "CUBE", "SPHERE" or "ARROWS", whose unit box holds nearly all of the splats."""
    region = bpy.data.objects.new(name, None)
    region[REGION] = True
    region.empty_display_type = shape
    cloud = splats.data
    places = [0.0] * (3 * len(cloud.points))
    cloud.attributes["position"].data.foreach_get("vector", places)
    axes = [sorted(places[axis::3]) for axis in range(3)]
    low, high = ([axis[int(part * (len(axis) - 1))] for axis in axes] for part in (0.02, 0.98))
    middle = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
    region.location = splats.matrix_world @ type(splats.location)(middle)
    region.scale = [(b - a) / 2 or 1.0 for a, b in zip(low, high, strict=True)]
    collection.objects.link(region)
    return region


def crop(splats: bpy.types.Object, collection: bpy.types.Collection, on: bool) -> bpy.types.Object | None:
    """Draw only the splats in a box, which is made the first time and kept when it is switched off; all of them where not `on`."""
    modifier = splats.modifiers[NAME]
    box = compat.get_modifier_input(modifier, "Crop Box")
    if on and box is None:
        box = add_region(splats, collection, f"Crop of {splats.name}", "CUBE")
        compat.set_modifier_input(modifier, "Crop Box", box)
    compat.set_modifier_input(modifier, "Crop", on)
    if box is not None:
        box.hide_viewport = not on
    return box
