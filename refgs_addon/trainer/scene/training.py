"""Train from a scene's settings. The buttons of the Train panel call these functions."""

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import bpy
from mathutils import Matrix, Vector

from ... import jobs
from ...blend_paths import check_own
from ...errors import InputError
from ...job_timers import follow_jobs
from ...json_file import read_json
from ...preferences import log_file
from ...scene.apply_edits import remember
from ...scene.capture_cameras import cameras_of, show_cameras
from ...scene.run_parts import EXAMPLE
from ...scene.run_toml import capture_of
from .. import commands
from ..preferences import capture_folder, hints_file, mask_model, python
from . import strokes
from .decisions import find_decision
from .training_box import artists_region, region_settings, show_found_region

if TYPE_CHECKING:
    import numpy as np

# of a training, the part that a hint repeats, and the minutes that it may take; as in backend/refgs/train/hints.py
REPEATED, AT_MOST = 0.6, 1.8
CHOSEN_NEEDS = ("specular", "reflections")  # needs that have a property in `refgs_addon.properties`


def check(scene: bpy.types.Scene) -> jobs.Job:
    """Start a job that reads the photos and cameras of the scene's capture and reports problems.

    The job's `results["check"]` is the report. Raises InputError if there is no trainer or no capture.
    """
    capture = _capture(scene)
    job = commands.check(python(), capture, capture_folder(capture), log_file(f"check {capture.name}"))
    follow_jobs()
    return job


def find_cameras(scene: bpy.types.Scene) -> jobs.Job:
    """Start a job that computes the cameras from the scene's photos, and then checks the capture.

    Earlier jobs that failed because the photos have no cameras are removed from the list of jobs. Raises InputError if there is no trainer
    or no capture.
    """
    capture = _capture(scene)
    job = commands.find_cameras(python(), capture, capture_folder(capture), log_file(f"cameras {capture.name}"))
    jobs.JOBS[:] = [known for known in jobs.JOBS if not known.no_cameras]
    follow_jobs()
    return job


def extract_photos(scene: bpy.types.Scene, video: Path, out: Path | None, count: int) -> jobs.Job:
    """Start a job that writes up to `count` photos from a video into `out`/images. When it is done, `out` becomes the scene's capture.

    If `out` is None, it is a new folder beside the video. Raises InputError if there is no trainer or no video, or if `out`/images exists.
    """
    if not video.is_file():
        raise InputError(f"{video} is not a file: choose a video, such as .mp4 or .mov")
    if out is None:
        coming = {Path(job.commands[0]["out"]) for job in jobs.JOBS if job.commands and "video" in job.commands[0]}
        out = _free(video.with_suffix(""), coming)
    job = commands.extract_photos(python(), video, out, count, log_file(f"frames {out.name}"))
    number = scene.session_uid

    def choose(job: jobs.Job) -> None:
        if known := _scene(number):
            known.refgs.capture = str(out)

    job.then = choose
    follow_jobs()
    return job


def make_masks(scene: bpy.types.Scene) -> jobs.Job:
    """Start a job that makes masks for the scene's capture, and then checks the capture.

    The trainer looks for the object in the training box if the artist placed one, otherwise in a box around the place that the cameras look
    at. If a segmentation model is chosen in the preferences, the trainer uses it to find the object. The coordinate frame of a training
    depends on the masks. So when the job is done, the cameras and the training box are shown at their places in the new frame. The
    canvases, images on which the artist paints strokes, show the new masks. Raises InputError if there is no trainer or no capture, if the
    box is flat, or if the capture's masks are being made already.
    """
    capture, mine = _capture(scene), artists_region(scene) is not None
    settings = region_settings(scene) if mine else {}
    settings.pop("region.up", None)  # turns the frame of a training, not that of the cameras
    log = log_file(f"masks {capture.name}")
    job = commands.make_masks(python(), capture, capture_folder(capture), log, settings, mask_model())
    jobs.JOBS[:] = [other for other in jobs.JOBS if other is job or not (other.ended and "masks" in other.results)]
    number = scene.session_uid

    def show(job: jobs.Job) -> None:
        _show_masks(number, capture, job.results["masks"])
        if known := _scene(number):
            checked = job.results["check"]
            show_cameras(known, Path(checked["capture"]), Path(checked["cameras"]))

    job.then = show
    follow_jobs()
    return job


def _show_masks(number: int, capture: Path, found: dict) -> None:
    """Show new masks, and move the scene's training box by the trainer's result `found`."""
    strokes.show_masks(capture, found["masks"])
    if known := _scene(number):
        box = artists_region(known)
        if box is None:
            show_found_region(known, found["region"])
        else:
            box.matrix_world = Matrix(found["moved"]) @ box.matrix_world


def save_strokes(scene: bpy.types.Scene) -> jobs.Job:
    """Save the capture's strokes, and start a job that makes its masks anew. Raises InputError."""
    python()  # say that there is none before anything is written
    strokes.save(_capture(scene))
    return make_masks(scene)


def train_other_way(scene: bpy.types.Scene, folder: Path, need: str) -> jobs.Job:
    """Start a job that trains like `train`, but with the opposite of one decision that the run in `folder` made.

    The decision is whether the optional part `need` of the training is kept (see `decisions`). The result goes into a new folder beside
    that run. If the scene's settings have a property for this part, it is set to the new answer.

    Raises InputError as `train` does. Also raises it if the run has no such decision, or was trained on another capture than the scene's.
    """
    decision, settings, trained = find_decision(folder, need), scene.refgs, _trained_capture(scene, folder)
    if trained is not None and trained.resolve() != _capture(scene).resolve():
        raise InputError(f"{folder.name} was trained on {trained}: choose that capture first")
    job = _train(
        scene, _free(folder, {Path(known.folder) for known in settings.runs}), {f"needs.{need}": decision.other}
    )
    if need in CHOSEN_NEEDS:
        setattr(settings, need, decision.other)
    return job


class HintPlan(NamedTuple):
    """Hold what a training with a hint would do: continue the run in `folder`, trained on `capture`, into the new folder `out`.

    `minutes` is about how long it takes, without the mesh.
    """

    folder: Path
    capture: Path
    out: Path
    minutes: int


def plan_hint(scene: bpy.types.Scene, collection: bpy.types.Collection) -> HintPlan:
    """Return what a training with a hint about a run would do. Raises InputError if the run's checkpoint or its capture is missing."""
    from ...scene.export_run import run_folder

    folder = run_folder(collection)
    if folder == EXAMPLE:
        raise InputError(
            "the example came without its photos: train on a capture of yours, and say there what is metal"
        )
    if not any((folder / "checkpoints").glob("*.toml")):
        raise InputError(f"{folder.name} has no checkpoint to train from: import the run as it was trained")
    capture = _trained_capture(scene, folder)
    if capture is None or not capture.is_dir():
        raise InputError(f"the photos of {folder.name} are no longer at {capture}: put them back there")
    try:
        minutes = min(REPEATED * float(read_json(folder / "metrics.json")["training_seconds"]) / 60, AT_MOST)
    except (InputError, KeyError, TypeError, ValueError):  # not there, or damaged
        minutes = AT_MOST
    out = _free(folder, {Path(known.folder) for known in scene.refgs.runs})
    return HintPlan(folder, capture, out, max(1, round(minutes)))


def train_with_hint(
    scene: bpy.types.Scene,
    collection: bpy.types.Collection,
    kind: str,
    ray: tuple[Vector, Vector] | None = None,
    points: "np.ndarray | None" = None,
) -> jobs.Job:
    """Start a job that repeats most of a run's training, and keeps a part of the surface metal or paint. `kind` is "metal" or "paint".

    The part has the splats at `points` (P, 3), in the splats' coordinates. If None, it is what the artist has chosen
    (`hints.chosen_part`). If nothing is chosen, it is the part that `ray` hits, a pair of origin and direction in world space. The result
    goes into a new folder beside the run. Raises InputError if one of these is missing: the trainer, the part, the run's checkpoint or its
    capture.
    """
    from ...scene.edit import splats_of
    from .hints import chosen_part, part_at, write_hint

    trainer, plan = python(), plan_hint(scene, collection)
    splats = splats_of(collection)
    if points is None:
        points = chosen_part(splats, bpy.context.view_layer.objects.active)
    if points is None:
        if ray is None:
            raise InputError("no part is chosen: click on it, or select its splats as points in Edit Mode")
        points = part_at(splats, *ray)
    file = hints_file(plan.out)
    write_hint(file, kind, points)
    asked = commands.Asked(plan.capture, plan.out, hinted=(plan.folder, file))
    job = commands.train(trainer, asked, log_file(plan.out.name), scene.refgs.mesh)
    remember(scene, plan.out, plan.capture)
    follow_jobs()
    return job


def train(scene: bpy.types.Scene) -> jobs.Job:
    """Start a job that trains on the scene's capture with the scene's settings. Add the new run folder to the scene's list.

    The job waits until earlier trainings have ended. Raises InputError if there is no trainer or no capture, if the run folder is not
    empty, or if the training box is flat.
    """
    out = scene.refgs.out
    return _train(scene, Path(bpy.path.abspath(out)) if out else _free_folder(_capture(scene), scene), {})


def _train(scene: bpy.types.Scene, out: Path, changes: dict[str, object]) -> jobs.Job:
    """Start a training into `out` with the scene's settings and `changes` of the trainer's settings."""
    settings, capture = scene.refgs, _capture(scene)
    preset, minutes = (None, settings.minutes) if settings.limited else (settings.preset, None)
    asked = commands.Asked(capture, out, preset, minutes, region_settings(scene) | _choices(settings) | changes)
    job = commands.train(python(), asked, log_file(out.name), settings.mesh)
    number = scene.session_uid

    def masked(found: dict) -> None:
        _show_masks(number, capture, found)
        if (known := _scene(number)) and (cameras := cameras_of(known, capture)):
            for camera in cameras.all_objects:
                camera.location = Matrix(found["moved"]) @ camera.location

    job.masked = masked
    remember(scene, out, capture)
    follow_jobs()
    return job


def make_mesh(run: Path) -> jobs.Job:
    """Start a job that makes the mesh and textures of a run folder. Raises InputError if there is no trainer."""
    job = commands.export(python(), run, log_file(run.name))
    follow_jobs()
    return job


def export_display_splats(collection: bpy.types.Collection, file: Path) -> jobs.Job:
    """Start a job in which the trainer writes a run with its edits as display splats, for viewers without lights.

    Display splats have fixed colours: how the run looks under the light recovered from the photos. An existing file is replaced. Raises
    InputError if the trainer, the run folder or the folder for the file is missing.
    """
    from ...scene.edit import is_edited, splats_of
    from ...scene.export_run import export_run, run_folder

    trainer, folder = python(), run_folder(collection)
    if not file.parent.is_dir():
        raise InputError(f"cannot write {file}: its folder does not exist")
    if is_edited(splats_of(collection)):
        edited = Path(tempfile.mkdtemp(dir=bpy.app.tempdir), folder.name)  # Blender deletes tempdir when it ends
        export_run(collection, edited, bake=False)
        folder = edited
    job = commands.display_splats(trainer, folder, file, log_file(f"export {file.stem}"))
    follow_jobs()
    return job


def resume(scene: bpy.types.Scene, folder: Path) -> jobs.Job:
    """Resume a run of the scene's list. Raises InputError where it is not stopped, or belongs to another .blend."""
    known = next((known for known in scene.refgs.runs if Path(known.folder) == folder), None)
    state = jobs.run_state(folder)
    if state == "training":
        raise InputError(f"{folder} is being trained already by another process: stop that or wait for it")
    if known is None or state != "stopped":
        raise InputError(f"{folder} has no stopped training to resume: start a new one")
    check_own(scene, folder)
    asked = commands.Asked(Path(known.capture), folder, resume=True)
    job = commands.train(python(), asked, log_file(folder.name), scene.refgs.mesh)
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
    """Return the trainer's settings that the artist chose, by name, without those on "auto"."""
    chosen = {
        "surfels.budget": settings.splats or "auto",
        "light.frame": settings.light,
        "light.exposure": settings.exposures,
        "needs.specular": settings.specular,
        "needs.reflections": settings.reflections,
    }
    return {name: value for name, value in chosen.items() if value != "auto"}


def _trained_capture(scene: bpy.types.Scene, run: Path) -> Path | None:
    """Return the capture that a run was trained on, or None if it is unknown."""
    known = next((known.capture for known in scene.refgs.runs if Path(known.folder) == run), "")
    return Path(known) if known else capture_of(run)


def _capture(scene: bpy.types.Scene) -> Path:
    if not scene.refgs.capture:
        raise InputError("no capture is chosen: choose the folder with the photos")
    capture = Path(bpy.path.abspath(scene.refgs.capture))
    if not capture.is_dir():
        raise InputError(f"{capture} is not a folder: choose the folder with the photos")
    return capture


def _scene(number: int) -> bpy.types.Scene | None:
    """Find a scene by its `session_uid`. Returns None if another file was opened meanwhile."""
    return next((scene for scene in bpy.data.scenes if scene.session_uid == number), None)


def _free_folder(capture: Path, scene: bpy.types.Scene) -> Path:
    """Return an unused path for a new run folder beside the capture."""
    return _free(capture.with_name(f"{capture.name} RefGS"), {Path(known.folder) for known in scene.refgs.runs})


def _free(wanted: Path, taken: set[Path]) -> Path:
    """Return the path `wanted`, with a number after it if it exists or is `taken`."""
    number, out = 1, wanted
    while out in taken or out.exists():
        number += 1
        out = wanted.with_name(f"{wanted.name} {number}")
    return out
