"""Export a run with its edits as a new run folder, or export its splats, mesh or recovered light alone."""

import os
import shutil
import tempfile
from pathlib import Path

import bpy
import numpy as np
from numpy.lib.recfunctions import append_fields

from ..errors import InputError
from ..nodes.kept_tree import ROW
from ..nodes.splats_tree import NAME as SPLATS
from ..ply_file import PLY_TYPES, read_rows
from .atomic_file import atomic_write
from .color_spaces import to_rec709
from .edit import edits, is_edited, splats_of
from .mesh_exchange import TEXTURES, write_mesh
from .run_parts import FOLDER, folder_of
from .splat_cloud import MATERIALS, SH_DC, finite_rows, read_constants, srgb_to_linear

KEPT = ("environment.exr", "cameras.json", "needs.json", "occluder.ply", "run.toml")
DARK = 0.02  # a darker base colour does not reveal how much light falls on it


def edited_materials(splats: bpy.types.Object) -> dict[str, np.ndarray]:
    """Return the splats' materials after all edits: base_color (N, 3) linear Rec.709, metallic (N,), roughness (N,).

    N is the number of splats that were not deleted. A fourth array, `row` (N,), has the index of each of these splats among all splats of
    the run.
    """
    drawing = splats.modifiers[SPLATS]
    before = drawing.show_viewport, splats.hide_viewport, splats.hide_get()
    drawing.show_viewport = splats.hide_viewport = False  # Blender does not evaluate hidden objects
    splats.hide_set(False)
    try:
        bpy.context.view_layer.update()
        cloud = splats.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        found = {}
        for name, field, width in (("base_color", "color", 4), ("metallic", "value", 1), ("roughness", "value", 1)):
            values = np.empty(width * len(cloud.points), np.float32)
            cloud.attributes[name].data.foreach_get(field, values)
            found[name] = values.reshape(-1, 4)[:, :3] if width == 4 else values
        color = to_rec709(found["base_color"])
        if color is not found["base_color"]:  # the working space may have colours that Rec.709 cannot show
            found["base_color"] = color.clip(0, 1)
        found[ROW] = np.arange(len(cloud.points), dtype=np.int32)
        if ROW in cloud.attributes:
            cloud.attributes[ROW].data.foreach_get("value", found[ROW])
    finally:
        drawing.show_viewport, splats.hide_viewport = before[:2]
        splats.hide_set(before[2])
    return found


def export_splats(collection: bpy.types.Collection, path: Path) -> None:
    """Write a run's splats with their edited materials as a splats.ply. Deleted splats are left out.

    Each splat also has a fixed colour (f_dc), for viewers without lights. Where an edit changes the base colour, the fixed colour changes
    by the same factor.

    Raises InputError if the run's splats.ply is missing, has changed since the import or has no materials. Also raises it if all splats are
    deleted, or if the new file cannot be written.
    """
    splats = splats_of(collection)
    source = run_folder(collection) / "splats.ply"
    rows, constants = finite_rows(read_rows(source)), read_constants(source)
    if len(rows) != len(splats.data.points):
        raise InputError(f"{run_folder(collection)} has changed since it was imported: import it again")
    if not {*MATERIALS} <= {*rows.dtype.names, *constants}:
        fix = "add them with `refgs export FILE.ply --splats splats.ply`, and import that file"
        raise InputError(f"{source} has no materials to edit: {fix}")
    new = edited_materials(splats)
    if not len(new[ROW]):
        raise InputError(f"all splats of {collection.name} are deleted: restore some")
    rows = rows[new[ROW]]
    if edits(splats):  # the splats may differ now: write columns
        columns = {name: np.full(len(rows), constants[name], "<f4") for name in MATERIALS[3:] if name in constants}
        rows = append_fields(rows, [*columns], [*columns.values()], usemask=False) if columns else rows
        constants = {}
    edited = np.zeros(len(rows), bool)
    for name in {*MATERIALS[3:]} & {*rows.dtype.names}:
        edited |= np.abs(new[name] - rows[name]) > 1e-6
        rows[name] = new[name]
    for i, channel in enumerate("rgb"):
        old, color, look = rows[f"albedo_{channel}"], new["base_color"][:, i], rows[f"f_dc_{i}"]
        changed = np.abs(color - old) > 1e-6
        edited |= changed
        light = srgb_to_linear(np.clip(0.5 + SH_DC * look, 0, 1)) / np.maximum(old, DARK)
        rows[f"f_dc_{i}"] = np.where(changed, (linear_to_srgb(color * light) - 0.5) / SH_DC, look)
        rows[f"albedo_{channel}"] = color
    for name in rows.dtype.names:
        if name.startswith("f_rest_"):
            rows[name][edited] = 0  # view dependence belongs to the old material
    types = {np.dtype(kind): name for name, kind in PLY_TYPES.items()}
    names = "".join(f"property {types[rows.dtype[name]]} {name}\n" for name in rows.dtype.names)
    said = "".join(f"comment constant {name} {value:g}\n" for name, value in constants.items())
    head = f"ply\nformat binary_little_endian 1.0\n{said}element vertex {len(rows)}\n{names}end_header\n"
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write(head.encode("ascii"))
        file.write(rows)


def export_run(collection: bpy.types.Collection, folder: Path) -> None:
    """Write a run with its edits as a new run folder. The run itself does not change.

    If the run was edited, its mesh is not copied, because its shape and textures do not contain the edits. `refgs export` or the trainer
    makes a new mesh. Raises InputError if the new folder exists already or cannot be written, or if the splats cannot be exported.
    """
    original = run_folder(collection)
    if folder.exists():
        raise InputError(f"{folder} exists: choose another name for the run")
    temporary = None
    try:
        temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        export_splats(collection, temporary / "splats.ply")
        kept = [*KEPT] if is_edited(splats_of(collection)) else [*KEPT, "mesh.glb"]
        for name in kept:
            if (original / name).is_file():
                shutil.copy2(original / name, temporary / name)
        if "mesh.glb" in kept and (original / TEXTURES).is_dir():
            shutil.copytree(original / TEXTURES, temporary / TEXTURES)
        temporary.chmod(0o755)  # mkdtemp makes folders that only the owner can read
        os.replace(temporary, folder)
    except OSError as error:
        raise InputError(f"cannot write {folder}: {error.strerror}") from None
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)


def export_light(collection: bpy.types.Collection, path: Path) -> None:
    """Copy a run's recovered light, an equirectangular EXR, to `path`. Raises InputError."""
    light = run_folder(collection) / "environment.exr"
    if not light.is_file():
        raise InputError(f"{light} does not exist: the run has no light")
    _copy(light, path)


def export_mesh(collection: bpy.types.Collection, path: Path, engine: str = "Any Program") -> None:
    """Write a run's mesh with its textures, as .glb, .usdc or .fbx. A .glb is a copy of the run's file.

    `mesh_exchange.write_mesh` writes the other two, with the extra textures that the game engine `engine` needs. Raises InputError if the
    run has no mesh, or if the run was edited: the mesh does not contain the edits.
    """
    mesh = run_folder(collection) / "mesh.glb"
    if is_edited(splats_of(collection)):
        raise InputError("the mesh lacks the edits: apply them to a new run, and export the mesh of that one")
    if not mesh.is_file():
        raise InputError(f"{mesh} does not exist: make the run's mesh first")
    if path.suffix.lower() == ".glb":
        _copy(mesh, path)
    else:
        write_mesh(mesh, path, engine)


def _copy(file: Path, path: Path) -> None:
    with atomic_write(path) as temporary:
        shutil.copyfile(file, temporary)


def run_folder(collection: bpy.types.Collection) -> Path:
    """Find the run folder of an imported collection. Raises InputError where it is missing."""
    folder = folder_of(collection)
    if folder is None:
        lost = bpy.path.abspath(collection.get(FOLDER, ""))
        raise InputError(f"the run of {collection.name} is no longer at {lost}: press Find Run Folder in the panel Run")
    return folder


def linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """Encode linear values as sRGB, clipped to 0..1."""
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
