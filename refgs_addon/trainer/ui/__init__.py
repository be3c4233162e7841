"""Register the trainer's operators and panels."""

from collections.abc import Callable
from pathlib import Path

import bpy

from ... import hooks, jobs
from .. import preferences, timers
from ..scene import batch_table, live_splats, training
from . import (
    capture_drop,
    checked_capture,
    closing,
    decisions_box,
    display_splats,
    highlight,
    hint_buttons,
    job_icons,
    many_panel,
    menus,
    photo_buttons,
    strokes_panel,
    train_panel,
    trainer_buttons,
)

_MODULES = (
    live_splats,
    timers,
    batch_table,
    trainer_buttons,
    job_icons,
    checked_capture,
    photo_buttons,
    decisions_box,
    train_panel,
    strokes_panel,
    closing,
    many_panel,
    highlight,
    hint_buttons,
    display_splats,
    menus,
    capture_drop,
)
CLASSES = [cls for module in _MODULES for cls in getattr(module, "CLASSES", ())]


def _mesh_maker() -> Callable[[Path], jobs.Job] | None:
    return training.make_mesh if preferences.set_up() else None


def register(package: str) -> None:
    preferences.register(package)
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    for module in _MODULES:
        if hasattr(module, "register"):
            module.register()
    hooks.mesh_maker = _mesh_maker


def unregister() -> None:
    hooks.mesh_maker = None
    preferences.unregister()
    for module in reversed(_MODULES):
        if hasattr(module, "unregister"):
            module.unregister()
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
