"""Run three timers. They poll this Blender's jobs, watch trainings in other processes, and read a batch's table. All redraw the windows.

A batch is the training of many captures in one job. Its table has a row for each run.
"""

from pathlib import Path

import bpy

from . import jobs
from .scene import batch_table, live_splats

POLL_SECONDS = 0.2  # a poll without news costs microseconds
PREVIEW_SECONDS = 4.0  # between the previews of a training
OTHER_SECONDS = 2.0  # between looks at runs that other processes train

_since_preview = 0.0
_batch = Path()  # folder of the batch whose table is shown


def follow_jobs() -> None:
    """Ensure that a timer polls the jobs until all have ended."""
    if not bpy.app.timers.is_registered(_poll_jobs):
        bpy.app.timers.register(_poll_jobs, first_interval=POLL_SECONDS, persistent=True)


def _poll_jobs() -> float | None:
    global _since_preview
    _since_preview += POLL_SECONDS
    changed = jobs.poll()
    if _since_preview >= PREVIEW_SECONDS:
        _since_preview = 0.0
        for job in jobs.JOBS:
            if job.run and job.state == "running" and job.curve and "train" not in job.results:
                job.tell("preview")
    live_splats.update()
    if changed:
        redraw()
    return POLL_SECONDS if any(not job.ended for job in jobs.JOBS) else None


def follow_other_processes() -> None:
    """Start a timer that redraws the panel every two seconds, while another process trains a run.

    Only the runs in the scenes' lists of runs count. When none of them is in training any more, the timer ends.
    """
    if not bpy.app.timers.is_registered(_poll_other_processes):
        bpy.app.timers.register(_poll_other_processes, first_interval=OTHER_SECONDS, persistent=True)


def _poll_other_processes() -> float | None:
    listed = {Path(known.folder) for scene in bpy.data.scenes for known in scene.refgs.runs}
    others = listed - {job.run for job in jobs.JOBS if not job.ended}
    redraw()
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
        redraw()
    return OTHER_SECONDS if jobs.run_state(_batch / jobs.LOGS) == "training" else None


def redraw() -> None:
    """Redraw the 3D views, the image editors, the preferences and the status bar."""
    manager = bpy.context.window_manager
    for window in manager.windows if manager else ():
        for area in window.screen.areas:
            if area.type in ("VIEW_3D", "IMAGE_EDITOR", "PREFERENCES"):
                area.tag_redraw()
        window.workspace.status_text_set_internal(None)  # the status bar is no area that could be tagged


def unregister() -> None:
    """Stop the timers and all jobs, except trainings that should continue after Blender closes."""
    for timer in (_poll_jobs, _poll_other_processes, _poll_batch):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    jobs.stop_all()
