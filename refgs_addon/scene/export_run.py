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
from ..ply_file import PLY_TYPES, read_rows
from .atomic_file import atomic_write
from .bake_edits import bake_edits
from .color_spaces import to_rec709
from .edit import edits, evaluated_splats, is_edited, splats_of
from .glb_pictures import has_pictures
from .mesh_exchange import TEXTURES, write_mesh
from .run_parts import FOLDER, folder_of
from .splat_cloud import MATERIALS, SH_DC, finite_rows, linear_to_srgb, read_constants, srgb_to_linear

KEPT = ("environment.exr", "cameras.json", "needs.json", "occluder.ply", "run.toml")
SURFELS = "comment SplatRenderMode: 2dgs\n"  # by which Brush, and programs after it, mark surfels
ADOPT = "give its splats materials with `refgs export FILE --splats FOLDER/splats.ply`, and import that folder"
DARK = 0.02  # a darker base colour does not reveal how much light falls on it


def edited_materials(splats: bpy.types.Object) -> dict[str, np.ndarray]:
    """Return the splats' materials after all edits: base_color (N, 3) linear Rec.709, metallic (N,), roughness (N,).

    N is the number of splats that were not deleted. A fourth array, `row` (N,), has the index of each of these splats among all splats of
    the run.
    """
    with evaluated_splats(splats) as cloud:
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
        raise InputError(f"{source} has no materials to edit: {ADOPT}")
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
    said = said if "scale_2" in rows.dtype.names else SURFELS + said
    head = f"ply\nformat binary_little_endian 1.0\n{said}element vertex {len(rows)}\n{names}end_header\n"
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write(head.encode("ascii"))
        file.write(rows)


def export_run(collection: bpy.types.Collection, folder: Path, bake: bool = True) -> None:
    """Write a run with its edits as a new run folder. The run itself does not change.

    If the run was edited, its mesh gets the edits by `bake_edits`. Without `bake`, or if its mesh has no textures, the new run gets no
    mesh: `refgs export` or the trainer makes one. Raises InputError if the new folder exists already or cannot be written, or if the splats
    or the mesh cannot be exported.
    """
    original = run_folder(collection)
    if folder.exists():
        raise InputError(f"{folder} exists: choose another name for the run")
    temporary = None
    try:
        temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        export_splats(collection, temporary / "splats.ply")
        for name in KEPT:
            if (original / name).is_file():
                shutil.copy2(original / name, temporary / name)
        mesh, textures = original / "mesh.glb", original / TEXTURES
        if mesh.is_file() and not is_edited(splats_of(collection)):
            shutil.copy2(mesh, temporary / mesh.name)
            if textures.is_dir():
                shutil.copytree(textures, temporary / TEXTURES)
        elif bake and mesh.is_file() and (textures.is_dir() or has_pictures(mesh)):
            bake_edits(collection, mesh, temporary)
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
    """Write a run's mesh with its textures and edits, as .glb, .usdc or .fbx. Without edits, a .glb is a copy of the run's file.

    `bake_edits` puts the edits into the textures. What the mesh has of deleted splats stays. `mesh_exchange.write_mesh` writes .usdc and
    .fbx, with the extra textures that the game engine `engine` needs. Raises InputError if the run has no mesh, or a file cannot be read or
    written.
    """
    mesh = run_folder(collection) / "mesh.glb"
    if not mesh.is_file():
        raise InputError(f"{mesh} does not exist: make the run's mesh first")
    if not path.parent.is_dir():
        raise InputError(f"cannot write {path}: its folder does not exist")
    with tempfile.TemporaryDirectory() as work:
        if edits(splats_of(collection)):
            mesh = bake_edits(collection, mesh, Path(work))
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
    if folder is None and FOLDER not in collection:
        raise InputError(f"{collection.name} is no run: {ADOPT}")
    if folder is None:
        lost = bpy.path.abspath(collection.get(FOLDER, ""))
        raise InputError(f"the run of {collection.name} is no longer at {lost}: press Find Run Folder in the panel Run")
    return folder
