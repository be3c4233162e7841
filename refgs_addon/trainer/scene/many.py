"""Train all captures of a folder. The buttons of the Train Many panel call these functions."""

from pathlib import Path

import bpy

from ... import jobs
from ...blend_paths import check_own
from ...errors import InputError
from ...job_timers import follow_jobs
from ...preferences import log_file
from .. import commands
from ..preferences import python


def results_folder(scene: bpy.types.Scene) -> Path | None:
    """Return the folder for the runs. If the artist has chosen none, it is a folder beside the folder of captures.

    Returns None if the artist has chosen no folder of captures either.
    """
    settings = scene.refgs.many
    if settings.results:
        return Path(bpy.path.abspath(settings.results))
    captures = _captures(scene)
    return captures and captures.with_name(f"{captures.name} RefGS")


def train_many(scene: bpy.types.Scene) -> jobs.Job:
    """Start a batch: a job that trains on all captures of the scene's folder. `batch_table` shows its progress.

    Steps that an earlier batch completed in the folder for the runs are not repeated. Raises InputError if there is no trainer or no folder
    of captures, if a batch is already running in the folder for the runs, or if that folder belongs to another .blend.
    """
    captures, out = _captures(scene), results_folder(scene)
    if captures is None:
        raise InputError("no captures are chosen: choose the folder that they are in")
    if out.exists():
        check_own(scene, out if scene.refgs.many.results else captures)
    trainer = python()
    jobs.JOBS[:] = [job for job in jobs.JOBS if not (job.ended and job.run == out / jobs.LOGS)]
    job = commands.train_many(trainer, captures, out, log_file(f"many {out.name}"), scene.refgs.many.preset)
    follow_jobs()
    return job


def _captures(scene: bpy.types.Scene) -> Path | None:
    chosen = scene.refgs.many.captures
    return Path(bpy.path.abspath(chosen)) if chosen else None
