"""Buttons and panels. They call the functions of `scene`, and hold no work of their own."""

import bpy

from .. import follow, preferences, properties
from . import capture, closing, drop, export, light, materials, operators, panels, pictures, trainer, training

CLASSES = (
    *preferences.CLASSES,
    *properties.CLASSES,
    *operators.CLASSES,
    *trainer.CLASSES,
    *capture.CLASSES,
    *training.CLASSES,
    *closing.CLASSES,
    *panels.CLASSES,
    *materials.CLASSES,
    *light.CLASSES,
    *export.CLASSES,
    *drop.CLASSES,
)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    properties.register()
    pictures.register()
    materials.register()
    light.register()
    export.register()
    training.register()
    closing.register()


def unregister() -> None:
    preferences.forget()
    follow.unregister()
    closing.unregister()
    training.unregister()
    export.unregister()
    light.unregister()
    materials.unregister()
    pictures.unregister()
    properties.unregister()
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
