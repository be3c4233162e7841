"""Ask trainings for previews, and run two timers: they watch trainings in other processes, and read a batch's table.

A batch is the training of many captures in one job. Its table has a row for each run.
"""

from pathlib import Path

import bpy

from .. import job_timers, jobs
from .scene import batch_table, live_splats

PREVIEW_SECONDS = 4.0  # between the previews of a training
OTHER_SECONDS = 2.0  # between looks at runs that other processes train

_since_preview = 0.0
_batch = Path()  # folder of the batch whose table is shown


def _after_poll() -> None:
    """Ask for a preview now and then, and show those that have come."""
    global _since_preview
    _since_preview += job_timers.POLL_SECONDS
    if _since_preview >= PREVIEW_SECONDS:
        _since_preview = 0.0
        for job in jobs.JOBS:
            if job.run and job.state == "running" and job.curve and "train" not in job.results:
                job.tell("preview")
    live_splats.update()


def follow_other_processes() -> None:
    """Start a timer that redraws the panel every two seconds, while another process trains a run.

    Only the runs in the scenes' lists of runs count. When none of them is in training any more, the timer ends.
    """
    if not bpy.app.timers.is_registered(_poll_other_processes):
        bpy.app.timers.register(_poll_other_processes, first_interval=OTHER_SECONDS, persistent=True)


def _poll_other_processes() -> float | None:
    listed = {Path(known.folder) for scene in bpy.data.scenes for known in scene.refgs.runs}
    others = listed - {job.run for job in jobs.JOBS if not job.ended}
    job_timers.redraw()
    return OTHER_SECONDS if any(jobs.run_state(folder) == "training" for folder in others) else None


def follow_batch(folder: Path) -> None:
    """Start a timer that reads the table of a batch now, and then every two seconds until the batch ends.

    A batch is the training of many captures. `folder` is the folder of its runs.
    """
    global _batch
    _batch = folder
    if not bpy.app.timers.is_registered(_poll_batch):
        bpy.app.timers.register(_poll_batch, first_interval=0.0, persistent=True)


def _poll_batch() -> float | None:
    if batch_table.show_table(_batch):
        job_timers.redraw()
    return OTHER_SECONDS if jobs.run_state(_batch / jobs.LOGS) == "training" else None


def register() -> None:
    job_timers.watchers.append(_after_poll)


def unregister() -> None:
    """Stop the timers and the jobs. Renders go on, and so do trainings that should continue after Blender closes."""
    job_timers.watchers.remove(_after_poll)
    for timer in (_poll_other_processes, _poll_batch):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    jobs.stop_all(but="render")
