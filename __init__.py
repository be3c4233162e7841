"""RefGS in Blender. The add-on's code is in refgs_addon; this is the door that Blender knocks on."""

# Imported in the functions, for Python also finds this file as the package around tests/, where there may be no Blender.


def register() -> None:
    from .refgs_addon import ui

    ui.register()


def unregister() -> None:
    from .refgs_addon import ui

    ui.unregister()
