"""Materials to start an edit from. They are Blender presets, a file each: the add-on's own, and those that the artist saves."""

import runpy
from pathlib import Path

import bpy
from bl_operators.presets import AddPresetBase

from .. import compat
from ..errors import InputError
from .atomic_file import whole

ROOT = Path(__file__).resolve().parents[1]  # the add-on's own are in the folder of presets there
PRESETS = "refgs_material"  # that folder's part with materials; the artist's has one of the same name
# What a file sets, each under its name as Python spells names (`base_color`): inputs of an edit. What it leaves out, an edit keeps.
INPUTS = ("Base Color", "Color Amount", "Metallic", "Metallic Amount", "Roughness", "Roughness Amount")


def materials() -> dict[str, Path]:
    """The files of all materials, by their names."""
    folders = [
        ROOT / "presets" / PRESETS,
        *map(Path, bpy.utils.preset_paths(PRESETS)),
        _own(),
    ]  # of two alike, the artist's
    files = (file for folder in folders for file in folder.glob("[!.]*.py"))
    found = {bpy.path.display_name(file.name, title_case=False): file for file in files}
    return dict(sorted(found.items()))


def read_material(name: str) -> dict[str, float | tuple[float, ...]]:
    """The inputs of an edit that a material sets, by their names: base colour RGBA, linear Rec.709, all others 0..1. Raises InputError."""
    file = materials().get(name)
    if file is None:
        raise InputError(f"there is no material {name}: take one of {', '.join(materials())}")
    try:
        found = runpy.run_path(str(file))  # bpy.utils.execfile leaves its bytecode beside the file, and would go by it
        return {key: _checked(key, found[_variable(key)]) for key in INPUTS if _variable(key) in found}
    except Exception as error:  # a preset is a script, which may do anything
        raise InputError(f"the material {file} cannot be read ({error}): remove it, and save it anew") from None


def set_material(edit: bpy.types.NodesModifier, name: str) -> None:
    """Give an edit the values of a material. Raises InputError."""
    give(edit, read_material(name))


def give(edit: bpy.types.NodesModifier, values: dict[str, float | tuple[float, ...]]) -> None:
    """Set inputs of an edit by their names."""
    for name, value in values.items():
        compat.set_modifier_input(edit, name, value)


def save_material(edit: bpy.types.NodesModifier, name: str) -> Path:
    """Save an edit's values as a preset of the artist's, for all files. Raises InputError where there is one of this name."""
    stem = AddPresetBase.as_filename(name)
    if not stem:
        raise InputError("the material has no name: type one first")
    file = _own() / f"{stem}.py"
    shown = bpy.path.display_name(file.name, title_case=False)
    if shown.casefold() in (known.casefold() for known in materials()):  # which may be one file
        raise InputError(f"there is a material {shown} already: choose another name")
    values = {key: _checked(key, compat.get_modifier_input(edit, key)) for key in INPUTS}
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write {file}: {error.strerror}") from None
    with whole(file) as temporary:
        lines = (f"{_variable(key)} = {value!r}\n" for key, value in values.items())
        temporary.write_text("".join(lines), encoding="utf-8")
    return file


def remove_material(name: str) -> None:
    """Remove a preset of the artist's. Raises InputError for any other."""
    file = materials().get(name)
    if file is None or file.parent != _own():
        raise InputError(f"{name} is none of the materials that you saved, and stays")
    try:
        file.unlink()
    except OSError as error:
        raise InputError(f"cannot remove {file}: {error.strerror}") from None


def _own() -> Path:
    """The folder of the artist's, which may not be there."""
    return Path(bpy.utils.user_resource("SCRIPTS", path=f"presets/{PRESETS}"))


def _variable(name: str) -> str:
    return name.lower().replace(" ", "_")


def _checked(name: str, value) -> float | tuple[float, ...]:
    """A value as an edit takes it. Rounded, for single precision makes 0.2 of what was typed 0.20000000298."""
    if name == "Base Color":
        r, g, b, alpha = value
        return tuple(round(float(part), 6) for part in (r, g, b, alpha))
    return round(float(value), 6)
