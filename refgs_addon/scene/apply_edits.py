"""Write a run with its edits as a new run folder."""

from pathlib import Path

import bpy

from .. import hooks, jobs


def apply_edits(scene: bpy.types.Scene, collection: bpy.types.Collection, out: Path) -> jobs.Job | None:
    """Write a run with its edits as a new run folder, and add the folder to the scene's list.

    If a trainer is set up, a job makes the mesh and textures, unless the new folder has those of the unedited run. Without a trainer, the
    edits are baked into the run's mesh here. Returns the job, or None. Raises InputError where the run cannot be exported.
    """
    from .export_run import export_run

    make_mesh = hooks.make_mesh()
    export_run(collection, out, bake=make_mesh is None)
    remember(scene, out)
    return None if make_mesh is None or (out / "mesh.glb").exists() else make_mesh(out)


def remember(scene: bpy.types.Scene, run: Path, capture: Path | None = None) -> None:
    """Add a run folder to the scene's list of runs. `capture` is the folder of the photos that it was trained on."""
    if all(Path(known.folder) != run for known in scene.refgs.runs):
        known = scene.refgs.runs.add()
        known.folder, known.capture = str(run), str(capture or "")
