"""Register the operators and panels. They only call functions of `scene`."""

import bpy

from .. import job_timers, preferences, properties
from . import (
    checked_capture,
    closing,
    drop,
    export_menu,
    icons,
    light_panel,
    materials_panel,
    operators,
    panels,
    train_panel,
    trainer_buttons,
)

_WITH_CLASSES = (
    preferences,
    properties,
    operators,
    trainer_buttons,
    checked_capture,
    train_panel,
    closing,
    panels,
    materials_panel,
    light_panel,
    export_menu,
    drop,
)
CLASSES = [cls for module in _WITH_CLASSES for cls in module.CLASSES]
_WITH_STATE = (properties, icons, materials_panel, light_panel, export_menu, train_panel, closing)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    for module in _WITH_STATE:
        module.register()


def unregister() -> None:
    preferences.forget()
    job_timers.unregister()
    for module in reversed(_WITH_STATE):
        module.unregister()
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
