"""RefGS in Blender. The add-on's code is in refgs_addon; this is the door that Blender knocks on."""


def register() -> None:
    from .refgs_addon import ui

    ui.register()


def unregister() -> None:
    from .refgs_addon import ui

    ui.unregister()
