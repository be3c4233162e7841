"""Find the parts of an imported run: its splats and mesh, the Empty that moves them, its cameras. Show the splats or the mesh."""

from pathlib import Path

import bpy

KEY = "refgs_part"  # custom property of an imported object: "splats" or "mesh"
CAMERAS = "refgs_cameras"  # custom property of the collection of a run's cameras
ROOT = "refgs_root"  # custom property of the Empty that moves a run: the run's longest side, in the Empty's coordinates
INSIDE = "RefGS Inside"  # modifier that draws a mesh in, under the splats
FOLDER = "refgs_folder"  # custom property of a run's collection: its run folder
THEIRS = "refgs_theirs"  # custom property of a run's collection: another program made its splats
DOUBT = "refgs_doubt"  # custom property of a run's collection: the trainer's words on where photos do not tell
# Run that comes with the add-on. Nothing is written into it: updates of the add-on replace it.
EXAMPLE = Path(__file__).resolve().parents[1] / "example" / "jar"


def parts(collection: bpy.types.Collection) -> dict[str, list[bpy.types.Object]]:
    """Return a run's objects under "splats" and "mesh", or {} for any other collection."""
    found: dict[str, list[bpy.types.Object]] = {}
    for item in collection.objects:
        if KEY in item:
            found.setdefault(item[KEY], []).append(item)
    return found


def root(collection: bpy.types.Collection) -> bpy.types.Object | None:
    """Find the Empty that moves an imported run, or return None if it was deleted."""
    return next((item for item in collection.objects if ROOT in item), None)


def cameras(collection: bpy.types.Collection) -> bpy.types.Collection | None:
    """Find the collection of a run's cameras. Returns None if the run has none."""
    return next((child for child in collection.children if CAMERAS in child), None)


def folder_of(collection: bpy.types.Collection) -> Path | None:
    """Return an imported run's folder, or None if it is no longer where it was."""
    folder = Path(bpy.path.abspath(collection.get(FOLDER, "")))
    return folder if collection.get(FOLDER) and (folder / "splats.ply").is_file() else None


def show(collection: bpy.types.Collection, part: str) -> None:
    """Show one part of a run, "splats" or "mesh", in the viewport and in renders, and hide the other part.

    If the splats are shown, the mesh is invisible to the camera, but it casts the run's shadows and appears in reflections.
    """
    found = parts(collection)
    for item in found.get("splats", []):
        item.hide_viewport = item.hide_render = part != "splats"
    for item in found.get("mesh", []):
        item.visible_camera = part == "mesh"
        if INSIDE in item.modifiers:
            item.modifiers[INSIDE].show_viewport = item.modifiers[INSIDE].show_render = part == "splats"


def shown(collection: bpy.types.Collection) -> str:
    """Tell which part of a run is shown, "splats" or "mesh"."""
    return "mesh" if all(item.hide_viewport for item in parts(collection).get("splats", [])) else "splats"


def stand_with(item: bpy.types.Object, other: bpy.types.Object) -> None:
    """Give `item` the parent and local transform of `other`."""
    item.parent, item.matrix_parent_inverse = other.parent, other.matrix_parent_inverse
    item.matrix_basis = other.matrix_basis


def active_run(context: bpy.types.Context) -> bpy.types.Collection | None:
    """Find the active object's run, or the scene's newest. Returns None if there is none."""
    runs = [collection for collection in context.scene.collection.children if parts(collection)]
    chosen = context.view_layer.objects.active
    of_chosen = [run for run in runs if chosen is not None and chosen.name in run.all_objects]
    return (of_chosen or runs or [None])[-1]
