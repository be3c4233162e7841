"""Read and save material presets, as Blender preset files. The add-on comes with some, and the artist can save more."""

import runpy
from pathlib import Path

import bpy
from bl_operators.presets import AddPresetBase

from .. import compat
from ..errors import InputError
from .atomic_file import atomic_write
from .color_spaces import from_rec709, to_rec709

ROOT = Path(__file__).resolve().parents[1]  # its folder `presets` has the add-on's own
PRESETS = "refgs_material"  # subfolder for materials, in the add-on's and in the artist's presets
# Inputs of an edit that a file may set, as Python names (`base_color`). An edit keeps its value for the others.
INPUTS = ("Base Color", "Color Amount", "Metallic", "Metallic Amount", "Roughness", "Roughness Amount")


def materials() -> dict[str, Path]:
    """Map all material presets' names to their files; the artist's presets take precedence."""
    folders = [ROOT / "presets" / PRESETS, *map(Path, bpy.utils.preset_paths(PRESETS)), _user_folder()]
    files = (file for folder in folders for file in folder.glob("[!.]*.py"))
    found = {bpy.path.display_name(file.name, title_case=False): file for file in files}
    return dict(sorted(found.items()))


def read_material(name: str) -> dict[str, float | tuple[float, ...]]:
    """Read a material preset. Returns a dictionary from the names of an edit's inputs, such as "Roughness Amount", to their values.

    A colour is RGBA in linear Rec.709; all other values are 0..1. Raises InputError if the preset is missing or invalid.
    """
    file = materials().get(name)
    if file is None:
        raise InputError(f"there is no material {name}: choose one of {', '.join(materials())}")
    try:
        found = runpy.run_path(str(file))  # bpy.utils.execfile would leave its bytecode beside the file, and use it
        return {key: _rounded(key, found[_identifier(key)]) for key in INPUTS if _identifier(key) in found}
    except Exception as error:  # a preset is a script: it may raise anything
        raise InputError(f"the material {file} cannot be read ({error}): remove it, and save it again") from None


def set_material(edit: bpy.types.NodesModifier, name: str) -> None:
    """Apply a material preset to an edit. Raises InputError where it is missing or invalid.

    The edit's name changes with it, as long as it begins with a material's name as `edit.add_edit` gave it.
    """
    set_inputs(edit, read_material(name))
    before, comma, where = edit.name.partition(", ")
    if comma and before in materials():
        edit.name = f"{name}, {where}"


def set_inputs(edit: bpy.types.NodesModifier, values: dict[str, float | tuple[float, ...]]) -> None:
    """Set an edit's inputs by name, with the base colour in linear Rec.709."""
    for name, value in values.items():
        compat.set_modifier_input(edit, name, from_rec709(value) if name == "Base Color" else value)


def save_material(edit: bpy.types.NodesModifier, name: str) -> Path:
    """Save an edit as a preset. Raises InputError where the name is empty or taken."""
    stem = AddPresetBase.as_filename(name)
    if not stem:
        raise InputError("the material has no name: type one first")
    file = _user_folder() / f"{stem}.py"
    shown = bpy.path.display_name(file.name, title_case=False)
    if shown.casefold() in (known.casefold() for known in materials()):  # some file systems ignore case
        raise InputError(f"the material {shown} exists already: choose another name")
    values = {key: compat.get_modifier_input(edit, key) for key in INPUTS}
    values["Base Color"] = to_rec709(tuple(values["Base Color"]))
    values = {key: _rounded(key, value) for key, value in values.items()}
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write {file}: {error.strerror}") from None
    with atomic_write(file) as temporary:
        lines = (f"{_identifier(key)} = {value!r}\n" for key, value in values.items())
        temporary.write_text("".join(lines), encoding="utf-8")
    return file


def remove_material(name: str) -> None:
    """Remove a preset that the artist saved. Raises InputError for any other preset."""
    file = materials().get(name)
    if file is None or not is_own(file):
        raise InputError(f"{name} is not a material that you saved: only those can be removed")
    try:
        file.unlink()
    except OSError as error:
        raise InputError(f"cannot remove {file}: {error.strerror}") from None


def is_own(file: Path) -> bool:
    """Check whether the artist saved a preset."""
    return file.parent == _user_folder()


def _user_folder() -> Path:
    """Return the folder of the artist's presets, which may not exist."""
    return Path(bpy.utils.user_resource("SCRIPTS", path=f"presets/{PRESETS}"))


def _identifier(name: str) -> str:
    return name.lower().replace(" ", "_")


def _rounded(name: str, value) -> float | tuple[float, ...]:
    """Round a value of an edit's input `name` to six decimals."""
    if name == "Base Color":
        r, g, b, alpha = value
        return tuple(round(float(part), 6) for part in (r, g, b, alpha))
    return round(float(value), 6)
