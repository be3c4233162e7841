"""Training from a scene's settings: what the buttons of the Train panel do."""

import tempfile
from pathlib import Path

import bpy

from .. import jobs
from ..errors import InputError
from ..job_timers import follow
from ..preferences import capture_folder, log_file, python, set_up
from .regions import region_settings


def check(scene: bpy.types.Scene) -> jobs.Job:
    """Have the scene's capture read; `results["check"]` of the job has what was found."""
    capture = _capture(scene)
    job = jobs.check(python(), capture, capture_folder(capture), log_file(f"check {capture.name}"))
    follow()
    return job


def find_cameras(scene: bpy.types.Scene) -> jobs.Job:
    """Have the cameras of the scene's photos found, in place of what said that they are missing; then the capture is read."""
    capture = _capture(scene)
    job = jobs.poses(python(), capture, capture_folder(capture), log_file(f"cameras {capture.name}"))
    jobs.JOBS[:] = [known for known in jobs.JOBS if not known.no_cameras]
    follow()
    return job


def train(scene: bpy.types.Scene) -> jobs.Job:
    """Train the scene's capture as its settings say, after what is being trained already. The scene remembers the run folder.

    Raises InputError where the trainer, the capture or a free folder is missing, or the region is flat.
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
    follow()
    return job


def apply_edits(scene: bpy.types.Scene, collection: bpy.types.Collection, out: Path) -> jobs.Job | None:
    """Write a run with its edits as a new run folder, which the scene remembers; the trainer makes its mesh and textures, where there
    is one, and the job is returned. Raises InputError."""
    from .export_run import export_run

    export_run(collection, out)
    _remember(scene, out)
    if (out / "mesh.glb").exists() or not set_up():
        return None
    job = jobs.export(python(), out, log_file(out.name))
    follow()
    return job


def export_display_splats(collection: bpy.types.Collection, file: Path) -> jobs.Job:
    """Have the trainer write a run with its edits as splats for viewers that know no light: they show what the run shows under its
    recovered light. What the file holds is replaced. Raises InputError where there is no trainer, no run or no folder to write to."""
    from .edit import edits, splats_of
    from .export_run import export_run, run_folder

    trainer, folder = python(), run_folder(collection)
    if not file.parent.is_dir():
        raise InputError(f"cannot write {file}: its folder is not there")
    if edits(splats_of(collection)):
        edited = Path(tempfile.mkdtemp(dir=bpy.app.tempdir), folder.name)  # Blender removes it when it ends
        export_run(collection, edited)
        folder = edited
    job = jobs.display_splats(trainer, folder, file, log_file(f"export {file.stem}"))
    follow()
    return job


def resume(scene: bpy.types.Scene, folder: Path) -> jobs.Job:
    """Go on with a run of the scene's that was stopped."""
    known = next((known for known in scene.refgs.runs if Path(known.folder) == folder), None)
    state = jobs.run_state(folder)
    if state == "training":
        raise InputError(f"{folder} is being trained already, by another process: stop that first, or wait for it")
    if known is None or state != "stopped":
        raise InputError(f"{folder} holds no training that was stopped: start a new one")
    mesh = scene.refgs.mesh
    job = jobs.train(python(), Path(known.capture), folder, log_file(folder.name), mesh=mesh, resume=True)
    follow()
    return job


def forget(scene: bpy.types.Scene, folder: Path) -> None:
    """No longer list a run; its folder stays as it is."""
    runs = scene.refgs.runs
    for number in reversed(range(len(runs))):
        if Path(runs[number].folder) == folder:
            runs.remove(number)
    jobs.JOBS[:] = [job for job in jobs.JOBS if not (job.ended and job.run == folder)]


def _choices(settings: bpy.types.PropertyGroup) -> dict[str, object]:
    """What a scene's settings have otherwise than the quality does, by the trainer's names."""
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
    """A folder beside the capture that is not there yet, nor about to be."""
    taken = {Path(known.folder) for known in scene.refgs.runs}
    number, out = 1, capture.with_name(f"{capture.name} RefGS")
    while out in taken or out.exists():
        number += 1
        out = capture.with_name(f"{capture.name} RefGS {number}")
    return out
