"""Regions: Empties that say which splats are meant, or what of a capture is to be trained."""

import math
from pathlib import Path

import bpy
from mathutils import Matrix, Vector

from .. import compat, jobs
from ..errors import InputError
from ..nodes.splats_tree import NAME

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


def training_region(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """The box of what is to be trained; none where the settings name none, or one that has been deleted."""
    box = scene.refgs.region
    return box if box is not None and scene in box.users_scene else None


def add_training_region(scene: bpy.types.Scene) -> bpy.types.Object:
    """The box of what is to be trained, shown. It is made where there is none: about what the cameras look at, as the capture's last
    check found it; else of 2 m about the origin, where the trainer puts that, with a radius of 1 m, but in captures of NeRF-Blender's
    layout."""
    box = training_region(scene)
    if box is None:
        box = bpy.data.objects.new("RefGS Region", None)
        box.empty_display_type = "CUBE"
        centre, radius = _looked_at(scene)
        box.matrix_world = Matrix.LocRotScale(centre, None, Vector((radius,) * 3))
        scene.collection.objects.link(box)
        scene.refgs.region = box
    box.hide_viewport = False
    return box


def _looked_at(scene: bpy.types.Scene) -> tuple[Vector, float]:
    capture = Path(bpy.path.abspath(scene.refgs.capture)).resolve()
    for job in reversed(jobs.JOBS):
        found = job.results.get("check", {})
        if "radius" in found and Path(found["capture"]) == capture:
            return Vector(found["centre"]), found["radius"]
    return Vector(), 1.0


def region_settings(scene: bpy.types.Scene) -> dict[str, list[float]]:
    """What the trainer is to be told of the scene's region, by the settings' names: its box, and the box's Z axis as the result's up. Empty
    where there is none. Raises InputError for a box that holds nothing."""
    box = training_region(scene)
    if box is None:
        return {}
    hidden, box.hide_viewport = box.hide_viewport, False  # what is hidden is not evaluated
    for layer in scene.view_layers:
        layer.update()  # what was moved a moment ago
    matrix = box.matrix_world.copy()
    box.hide_viewport = hidden
    centre, turn, scale = matrix.decompose()
    size = [2 * abs(x) * box.empty_display_size for x in scale]
    if min(size) < 1e-6 * max(size) or not max(size):
        raise InputError(f"{box.name} is flat: scale it so that it holds what is to be trained")
    return {
        "region.centre": list(centre),
        "region.size": size,
        "region.rotation": [math.degrees(angle) for angle in turn.to_euler("XYZ")],
        "region.up": list(matrix.col[2].to_3d().normalized()),
    }
