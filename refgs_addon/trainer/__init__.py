"""Add the trainer to the add-on: the panels Train and Train Many, hints, display splats, and the trainer's installation.

The trainer's extension has this package. It loads it into the extension RefGS, of which nothing imports it.
"""


def register(package: str) -> None:
    """Add the trainer to the add-on. `package` is the extension that has the preferences."""
    from . import ui

    ui.register(package)


def unregister() -> None:
    from . import ui

    ui.unregister()
