"""Buttons and panels. They call the functions of `scene`, and hold no work of their own."""

import bpy

from . import operators, panels

CLASSES = (*operators.CLASSES, *panels.CLASSES)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
