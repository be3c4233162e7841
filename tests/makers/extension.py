"""Enable the add-on and the trainer's extension in this process, from the sources, where Blender would load them from their folders."""

import bpy

import refgs_addon
from refgs_addon import preferences, trainer, ui
from refgs_trainer import joining
from refgs_trainer.preferences import Preferences


def enable() -> None:
    """Register the add-on, and then the trainer."""
    ui.register()
    bpy.utils.register_class(Preferences)
    trainer.register(joining.PACKAGE)
    joining._addon = refgs_addon


def disable() -> None:
    """Unregister the trainer, and then the add-on."""
    joining._addon = None
    trainer.unregister()
    bpy.utils.unregister_class(Preferences)
    ui.unregister()


def list_in_preferences() -> list[bpy.types.Addon]:
    """List both among Blender's enabled add-ons, so that they have preferences. Returns their entries."""
    entries = []
    for package in (preferences.PACKAGE, joining.PACKAGE):
        entries.append(bpy.context.preferences.addons.new())
        entries[-1].module = package
    return entries
