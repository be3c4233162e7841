"""RefGS in Blender: the entry point that Blender loads. The add-on's code is in refgs_addon."""


def register() -> None:
    from .refgs_addon import ui

    ui.register()


def unregister() -> None:
    from .refgs_addon import ui

    ui.unregister()
