"""RefGS in Blender: the entry point that Blender loads. The add-on's code is in refgs_addon."""


def register() -> None:
    from .refgs_addon import hooks, ui

    ui.register()
    hooks.tell_extensions("refgs_enabled", __package__)


def unregister() -> None:
    from .refgs_addon import hooks, ui

    hooks.tell_extensions("refgs_disabled")
    ui.unregister()
