"""Find the extension RefGS, in whichever repository it is, and make the package `trainer` a part of it.

`trainer` imports RefGS's modules by relative imports. For them its name begins with that of RefGS's package, such as
`bl_ext.user_default.refgs.refgs_addon.trainer`: its folder is added to that package's path.
"""

import importlib
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import addon_utils
import bpy

PACKAGE = __package__
ID = "refgs"  # of the extension RefGS
HERE = Path(__file__).resolve().parent  # contains the package `trainer`
KEYS = ("python", "mask_model")  # preferences that RefGS had, when the trainer was a part of it

_addon: ModuleType | None = None  # RefGS's package refgs_addon, while the trainer is a part of it


def find_enabled() -> str:
    """Return the name of RefGS's module, or "" if RefGS is not enabled."""
    for addon in bpy.context.preferences.addons:
        if _is_refgs(addon.module) and getattr(sys.modules.get(addon.module), "__addon_enabled__", False):
            return addon.module
    return ""


def trainer() -> ModuleType | None:
    """Return the package `trainer`, or None while it is not a part of RefGS."""
    return None if _addon is None else sys.modules[f"{_addon.__name__}.trainer"]


def problem() -> str:
    """Say in one line why the trainer is not a part of RefGS, or return "" if it is."""
    if _addon is not None:
        return ""
    own = _version(HERE)
    if enabled := find_enabled():
        return f"RefGS {_version(_folder(enabled))} and its trainer {own} do not fit: update both"
    if any(_is_refgs(module.__name__) for module in addon_utils.modules(refresh=False)):
        return "RefGS is disabled: enable it in Preferences > Add-ons"
    return f"RefGS is missing: install that extension, version {own}"


def join(package: str) -> None:
    """Make the trainer a part of RefGS, if RefGS has the same version. `package` is the name of RefGS's module, or "" without RefGS."""
    global _addon
    leave()
    if not package or not _fits(_folder(package)):
        return
    addon = importlib.import_module(f"{package}.refgs_addon")
    addon.__path__.append(str(HERE))
    try:
        importlib.import_module(f"{addon.__name__}.trainer").register(PACKAGE)
    except BaseException:
        _unload(addon)
        raise
    _addon = addon
    _take_over(package)


def leave() -> None:
    """Take the trainer out of RefGS."""
    global _addon
    if _addon is not None:
        addon, module, _addon = _addon, trainer(), None
        try:
            module.unregister()
        finally:
            _unload(addon)


def _unload(addon: ModuleType) -> None:
    addon.__path__.remove(str(HERE))
    name = f"{addon.__name__}.trainer"
    for key in [key for key in sys.modules if key == name or key.startswith(f"{name}.")]:
        del sys.modules[key]
    vars(addon).pop("trainer", None)


def _take_over(package: str) -> None:
    """Move the preferences here that an earlier release stored in RefGS, whose module is `package`."""
    before, own = (bpy.context.preferences.addons.get(name) for name in (package, PACKAGE))
    if before is None or own is None:
        return
    before, own = before.preferences, own.preferences
    # From Blender 5.0 on, values of properties are apart from custom properties.
    stored = before.bl_system_properties_get() if hasattr(before, "bl_system_properties_get") else before
    for key in KEYS:
        if stored is not None and isinstance(value := stored.get(key), str):
            del stored[key]
            bpy.context.preferences.is_dirty = True
            if value and not getattr(own, key):
                setattr(own, key, value)


def _is_refgs(module: str) -> bool:
    return module.startswith("bl_ext.") and module.rpartition(".")[2] == ID


def _folder(module: str) -> Path:
    return Path(sys.modules[module].__file__).resolve().parent


def _fits(folder: Path) -> bool:
    """Check whether RefGS in a folder is of this version. The last release that had the trainer inside lacks the hooks."""
    return _version(folder) == _version(HERE) and (folder / "refgs_addon" / "hooks.py").is_file()


def _version(folder: Path) -> str:
    return tomllib.loads((folder / "blender_manifest.toml").read_text(encoding="utf-8"))["version"]
