"""Add and read the box that limits what is trained. A scene has at most one, an Empty."""

import json
import math
from pathlib import Path

import bpy
from mathutils import Matrix, Vector

from ... import jobs
from ...errors import InputError
from ...scene.regions import training_region

FOUND = "refgs_found"  # custom property of the training box: its matrix when the program placed it
ROOM = 1.15  # factor on a found box: thin parts may reach out of what was carved
GUESSED = "refgs_guessed"  # custom property of the training box: it was guessed from cameras alone
GUESS = 1.25  # half an edge of a guessed box in radii of what the cameras look at, as in backend/refgs/capture/masks.py


def add_training_region(scene: bpy.types.Scene) -> bpy.types.Object:
    """Show the training box, and make it if there is none. Only what is inside this box is trained.

    If the box was only guessed from the cameras, it counts as placed by the artist from now on. A new box encloses the sphere that the
    cameras look at, as the check of the capture found it.

    If the capture was not checked, the new box is 2 m wide around the origin. This suits most captures: the trainer turns, moves and scales
    the cameras so that the sphere fits this box. Captures from NeRF-Blender usually keep their cameras unchanged.
    """
    box = training_region(scene)
    if box is None:
        box = _new_training_region(scene)
        centre, radius = _looked_at(scene)
        box.matrix_world = Matrix.LocRotScale(centre, None, Vector((radius,) * 3))
    elif GUESSED in box:  # asked for: it is the artist's now
        del box[FOUND], box[GUESSED]
    box.hide_viewport = False
    return box


def show_guessed_region(scene: bpy.types.Scene, centre: list[float], radius: float) -> None:
    """Add a guessed training box around the sphere that the cameras look at, unless the scene has a training box.

    The trainer will look for the object in this box when it makes masks. The box limits no training until the artist changes it, or presses
    Add Region. `centre` and `radius` are those of the sphere.
    """
    if training_region(scene) is None:
        box = _new_training_region(scene)
        box.matrix_world = Matrix.LocRotScale(Vector(centre), None, Vector((GUESS * radius,) * 3))
        box[FOUND], box[GUESSED] = [x for row in _world_matrix(scene, box) for x in row], True


def remove_guessed_region(scene: bpy.types.Scene) -> None:
    """Remove the training box if it is a guess that the artist has not changed."""
    box = training_region(scene)
    if box is not None and _is_guess(scene, box):
        bpy.data.objects.remove(box)


def _is_guess(scene: bpy.types.Scene, box: bpy.types.Object) -> bool:
    return GUESSED in box and artists_region(scene) is None


def show_found_region(scene: bpy.types.Scene, settings: list[str]) -> bpy.types.Object:
    """Move the training box to where the trainer found the object when it made masks. Make the box if there is none.

    The box is a little larger than the object. `settings` are settings of the trainer, such as "region.size=[1, 1, 2]". Until the artist
    changes the box, `artists_region` does not return it.
    """
    values = {key: json.loads(value) for key, value in (word.split("=", 1) for word in settings)}
    box = training_region(scene) or _new_training_region(scene)
    box.empty_display_size, box.hide_viewport = 1.0, False
    half = Vector(values["region.size"]) / 2 * ROOM
    box.matrix_world = Matrix.LocRotScale(Vector(values["region.centre"]), None, half)
    box[FOUND] = [x for row in _world_matrix(scene, box) for x in row]
    if GUESSED in box:
        del box[GUESSED]
    return box


def artists_region(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """Return the training box if the artist made or changed it, else None."""
    box = training_region(scene)
    if box is None or FOUND not in box:
        return box
    now = [x for row in _world_matrix(scene, box) for x in row]
    same = all(math.isclose(a, b, rel_tol=1e-5, abs_tol=1e-6) for a, b in zip(now, box[FOUND], strict=True))
    return None if same else box


def _new_training_region(scene: bpy.types.Scene) -> bpy.types.Object:
    box = bpy.data.objects.new("RefGS Region", None)
    box.empty_display_type = "CUBE"
    scene.collection.objects.link(box)
    scene.refgs.region = box
    return box


def _world_matrix(scene: bpy.types.Scene, box: bpy.types.Object) -> Matrix:
    """Return an object's current matrix to world space, even if it is hidden."""
    hidden, box.hide_viewport = box.hide_viewport, False  # Blender does not evaluate hidden objects
    for layer in scene.view_layers:
        layer.update()
    matrix = box.matrix_world.copy()
    box.hide_viewport = hidden
    return matrix


def _looked_at(scene: bpy.types.Scene) -> tuple[Vector, float]:
    capture = Path(bpy.path.abspath(scene.refgs.capture)).resolve()
    for job in reversed(jobs.JOBS):
        found = job.results.get("check", {})
        if "radius" in found and Path(found["capture"]) == capture:
            return Vector(found["centre"]), found["radius"]
    return Vector(), 1.0


def region_settings(scene: bpy.types.Scene) -> dict[str, list[float]]:
    """Return the trainer's settings for the scene's training box. Return {} if there is no box, or only a guessed one.

    The settings are region.centre, region.size (the lengths of its sides), region.rotation (XYZ Euler angles in degrees) and region.up (the
    box's Z axis as a unit vector). Only what is inside the box is trained, and region.up becomes the result's up direction. Raises
    InputError if the box has no volume.
    """
    box = training_region(scene)
    if box is None or _is_guess(scene, box):
        return {}
    matrix = _world_matrix(scene, box)
    centre, turn, scale = matrix.decompose()
    size = [2 * abs(x) * box.empty_display_size for x in scale]
    if min(size) < 1e-6 * max(size) or not max(size):
        raise InputError(f"{box.name} is flat: scale it until it contains what is to be trained")
    return {
        "region.centre": list(centre),
        "region.size": size,
        "region.rotation": [math.degrees(angle) for angle in turn.to_euler("XYZ")],
        "region.up": list(matrix.col[2].to_3d().normalized()),
    }
