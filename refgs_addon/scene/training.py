"""Train from a scene's settings. The buttons of the Train panel call these functions."""

import tempfile
from pathlib import Path

import bpy

from .. import jobs
from ..errors import InputError
from ..job_timers import follow_jobs
from ..preferences import capture_folder, log_file, python, set_up
from .regions import region_settings


def check(scene: bpy.types.Scene) -> jobs.Job:
    """Start a job that reads the photos and cameras of the scene's capture and reports problems.

    The job's `results["check"]` is the report. Raises InputError if there is no trainer or no capture.
    """
    capture = _capture(scene)
    job = jobs.check(python(), capture, capture_folder(capture), log_file(f"check {capture.name}"))
    follow_jobs()
    return job


def find_cameras(scene: bpy.types.Scene) -> jobs.Job:
    """Start a job that computes the cameras from the scene's photos, and then checks the capture.

    Earlier jobs that failed because the photos have no cameras are removed from the list.
    """
    capture = _capture(scene)
    job = jobs.find_cameras(python(), capture, capture_folder(capture), log_file(f"cameras {capture.name}"))
    jobs.JOBS[:] = [known for known in jobs.JOBS if not known.no_cameras]
    follow_jobs()
    return job


def train(scene: bpy.types.Scene) -> jobs.Job:
    """Start a job that trains on the scene's capture with the scene's settings. Add the new run folder to the scene's list.

    The job waits until earlier trainings have ended. Raises InputError if there is no trainer or no capture, if the run folder is not
    empty, or if the training box is flat.
    """
    settings, capture = scene.refgs, _capture(scene)
    out = Path(bpy.path.abspath(settings.out)) if settings.out else _free_folder(capture, scene)
    words = {
        "preset": None if settings.limited else settings.preset,
        "minutes": settings.minutes if settings.limited else None,
        "mesh": settings.mesh,
        "settings": region_settings(scene) | _choices(settings),
    }
    job = jobs.train(python(), capture, out, log_file(out.name), **words)
    _remember(scene, out, capture)
    follow_jobs()
    return job


def apply_edits(scene: bpy.types.Scene, collection: bpy.types.Collection, out: Path) -> jobs.Job | None:
    """Write a run with its edits as a new run folder, and add the folder to the scene's list.

    If the new folder has no mesh and a trainer is set up, a job makes the mesh and textures. Returns that job, or None. Raises InputError
    where the run cannot be exported.
    """
    from .export_run import export_run

    export_run(collection, out)
    _remember(scene, out)
    if (out / "mesh.glb").exists() or not set_up():
        return None
    job = jobs.export(python(), out, log_file(out.name))
    follow_jobs()
    return job


def export_display_splats(collection: bpy.types.Collection, file: Path) -> jobs.Job:
    """Start a job in which the trainer writes a run with its edits as display splats, for viewers without lights.

    Display splats have fixed colours: how the run looks under the light recovered from the photos. An existing file is replaced. Raises
    InputError if there is no trainer, or the run or the file's folder does not exist.
    """
    from .edit import edits, splats_of
    from .export_run import export_run, run_folder

    trainer, folder = python(), run_folder(collection)
    if not file.parent.is_dir():
        raise InputError(f"cannot write {file}: its folder does not exist")
    if edits(splats_of(collection)):
        edited = Path(tempfile.mkdtemp(dir=bpy.app.tempdir), folder.name)  # Blender deletes tempdir when it ends
        export_run(collection, edited)
        folder = edited
    job = jobs.display_splats(trainer, folder, file, log_file(f"export {file.stem}"))
    follow_jobs()
    return job


def resume(scene: bpy.types.Scene, folder: Path) -> jobs.Job:
    """Start a job that resumes a stopped run of the scene's list. Raises InputError if the run is not stopped or not in the list."""
    known = next((known for known in scene.refgs.runs if Path(known.folder) == folder), None)
    state = jobs.run_state(folder)
    if state == "training":
        raise InputError(f"{folder} is being trained already by another process: stop that or wait for it")
    if known is None or state != "stopped":
        raise InputError(f"{folder} has no stopped training to resume: start a new one")
    mesh = scene.refgs.mesh
    job = jobs.train(python(), Path(known.capture), folder, log_file(folder.name), mesh=mesh, resume=True)
    follow_jobs()
    return job


def forget(scene: bpy.types.Scene, folder: Path) -> None:
    """Remove a run from the scene's list. The run folder stays on the disk."""
    runs = scene.refgs.runs
    for number in reversed(range(len(runs))):
        if Path(runs[number].folder) == folder:
            runs.remove(number)
    jobs.JOBS[:] = [job for job in jobs.JOBS if not (job.ended and job.run == folder)]


def _choices(settings: bpy.types.PropertyGroup) -> dict[str, object]:
    """Return the settings that the artist chose, as {trainer's name of the setting: value}. Leave out settings whose value is "auto"."""
    chosen = {
        "surfels.budget": settings.splats or "auto",
        "light.frame": settings.light,
        "light.exposure": settings.exposures,
        "needs.specular": settings.specular,
        "needs.reflections": settings.reflections,
    }
    return {name: value for name, value in chosen.items() if value != "auto"}


def _remember(scene: bpy.types.Scene, run: Path, capture: Path | None = None) -> None:
    if all(Path(known.folder) != run for known in scene.refgs.runs):
        known = scene.refgs.runs.add()
        known.folder, known.capture = str(run), str(capture or "")


def _capture(scene: bpy.types.Scene) -> Path:
    if not scene.refgs.capture:
        raise InputError("no capture is chosen: choose the folder with the photos")
    capture = Path(bpy.path.abspath(scene.refgs.capture))
    if not capture.is_dir():
        raise InputError(f"{capture} is not a folder: choose the folder with the photos")
    return capture


def _free_folder(capture: Path, scene: bpy.types.Scene) -> Path:
    """Return a path for a new run folder beside the capture. Nothing exists there, and no run of the scene's list uses it."""
    taken = {Path(known.folder) for known in scene.refgs.runs}
    number, out = 1, capture.with_name(f"{capture.name} RefGS")
    while out in taken or out.exists():
        number += 1
        out = capture.with_name(f"{capture.name} RefGS {number}")
    return out
