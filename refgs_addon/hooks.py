"""Let the trainer's extension add to this one, which runs without it and imports nothing of it."""

import sys
import traceback
from collections.abc import Callable
from pathlib import Path

import bpy

from . import jobs

mesh_maker: Callable[[], Callable[[Path], jobs.Job] | None] | None = None
"""Function of the trainer's extension while it is enabled. It returns what `make_mesh` returns."""


def has_trainer() -> bool:
    """Check whether the trainer's extension is enabled."""
    return mesh_maker is not None


def make_mesh() -> Callable[[Path], jobs.Job] | None:
    """Return a function that starts a job that makes the mesh of a run folder, or None where no trainer is set up."""
    return mesh_maker() if mesh_maker else None


def tell_extensions(event: str, *facts: object) -> None:
    """Call the function `event` of each enabled extension that has one.

    The events are `refgs_enabled(package)`, after this extension was enabled, and `refgs_disabled()`, before it is disabled.
    """
    for addon in bpy.context.preferences.addons:
        listen = getattr(sys.modules.get(addon.module), event, None)
        if listen is not None:
            try:
                listen(*facts)
            except Exception:  # a fault of that extension: this one goes on
                traceback.print_exc()
