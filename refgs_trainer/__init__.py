"""RefGS's trainer in Blender: the entry point that Blender loads.

The code is in refgs_addon/trainer, which the extension's zip has as the package `trainer`. It runs inside the extension RefGS, as a part
of that package, while both are enabled.
"""

import bpy

from . import joining, preferences


def register() -> None:
    bpy.utils.register_class(preferences.Preferences)
    bpy.utils.register_class(preferences.ProblemPanel)
    joining.join(joining.find_enabled())


def unregister() -> None:
    joining.leave()
    bpy.utils.unregister_class(preferences.ProblemPanel)
    bpy.utils.unregister_class(preferences.Preferences)


def refgs_enabled(package: str) -> None:
    """Join RefGS, which calls this function when it was enabled. `package` is its module's name."""
    joining.join(package)


def refgs_disabled() -> None:
    """Leave RefGS, which calls this function before it is disabled."""
    joining.leave()
