"""Timers: one takes in what the jobs say, and has the window drawn anew where that changed anything; one looks after runs that other
processes train."""

from pathlib import Path

import bpy

from . import jobs
from .scene import live_splats

EVERY = 0.2  # seconds between looks while there is a job, which cost microseconds when nothing was said
LOOK = 4.0  # seconds between previews of a training
ELSEWHERE = 2.0  # seconds between looks at runs that others train

_since_look = 0.0


def follow() -> None:
    """Look at the jobs from now on, until all have ended."""
    if not bpy.app.timers.is_registered(_look):
        bpy.app.timers.register(_look, first_interval=EVERY, persistent=True)


def _look() -> float | None:
    global _since_look
    _since_look += EVERY
    changed = jobs.poll()
    if _since_look >= LOOK:
        _since_look = 0.0
        for job in jobs.JOBS:
            if job.run and job.state == "running" and job.progress and "train" not in job.results:
                job.tell("preview")
    live_splats.update()
    if changed:
        redraw()
    return EVERY if any(not job.ended for job in jobs.JOBS) else None


def follow_elsewhere() -> None:
    """Draw the panel anew now and then, as long as a process that is not of this Blender trains a run that is listed."""
    if not bpy.app.timers.is_registered(_look_elsewhere):
        bpy.app.timers.register(_look_elsewhere, first_interval=ELSEWHERE, persistent=True)


def _look_elsewhere() -> float | None:
    listed = {Path(known.folder) for scene in bpy.data.scenes for known in scene.refgs.runs}
    others = listed - {job.run for job in jobs.JOBS if not job.ended}
    trained = any(jobs.run_state(folder) == "training" for folder in others)
    redraw()
    return ELSEWHERE if trained else None


def redraw() -> None:
    """Draw the panel, the preferences and the status bar anew."""
    manager = bpy.context.window_manager
    for window in manager.windows if manager else ():
        for area in window.screen.areas:
            if area.type in ("VIEW_3D", "PREFERENCES"):
                area.tag_redraw()
        window.workspace.status_text_set_internal(None)  # the bar is no area that could be tagged


def unregister() -> None:
    """Follow no longer, and end the jobs cleanly but those that are kept."""
    for timer in (_look, _look_elsewhere):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)
    jobs.stop_all()
