"""Register the add-on's operators and panels. They leave the work to functions of other modules, mostly of the package `scene`."""

import bpy

from .. import blend_paths, job_timers, preferences, properties
from . import drop, export_menu, icons, light_panel, materials_panel, menus, operators, panels

_MODULES = (preferences, properties, blend_paths, operators, icons, panels)
_MODULES += (materials_panel, light_panel, export_menu, menus, drop)
CLASSES = [cls for module in _MODULES for cls in getattr(module, "CLASSES", ())]


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    for module in _MODULES:
        if hasattr(module, "register"):
            module.register()


def unregister() -> None:
    job_timers.unregister()
    for module in reversed(_MODULES):
        if hasattr(module, "unregister"):
            module.unregister()
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
