"""Run the timer that polls this Blender's jobs and redraws the windows."""

from collections.abc import Callable

import bpy

from . import jobs

POLL_SECONDS = 0.2  # a poll without news costs microseconds

watchers: list[Callable[[], None]] = []
"""Functions that the timer calls after each poll."""


def follow_jobs() -> None:
    """Ensure that a timer polls the jobs until all have ended."""
    if not bpy.app.timers.is_registered(_poll_jobs):
        bpy.app.timers.register(_poll_jobs, first_interval=POLL_SECONDS, persistent=True)


def _poll_jobs() -> float | None:
    changed = jobs.poll()
    for watch in watchers:
        watch()
    if changed:
        redraw()
    return POLL_SECONDS if any(not job.ended for job in jobs.JOBS) else None


def redraw() -> None:
    """Redraw the 3D views, the image editors, the preferences and the status bar."""
    manager = bpy.context.window_manager
    for window in manager.windows if manager else ():
        for area in window.screen.areas:
            if area.type in ("VIEW_3D", "IMAGE_EDITOR", "PREFERENCES"):
                area.tag_redraw()
        window.workspace.status_text_set_internal(None)  # the status bar is no area that could be tagged


def unregister() -> None:
    """Stop the timer and all jobs, except trainings that should continue after Blender closes."""
    if bpy.app.timers.is_registered(_poll_jobs):
        bpy.app.timers.unregister(_poll_jobs)
    jobs.stop_all()
