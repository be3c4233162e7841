"""RefGS in Blender. The add-on's code is in refgs_addon; this is the door that Blender knocks on."""

from .refgs_addon import ui


def register() -> None:
    ui.register()


def unregister() -> None:
    ui.unregister()
