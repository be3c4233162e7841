"""Write runs into an asset library: a folder of .blend files, one for each run. Blender's asset browser shows the library."""

from pathlib import Path

import bpy

from .atomic_file import atomic_write, unwritable

LIBRARY = "library"  # folder among the runs, as in backend/refgs/batch/listing.py
CATALOG = "RefGS"
CATALOG_ID = "8f1f0b52-6a0c-4c34-9b59-4f0c3d3b7c21"
_CATALOGS = "blender_assets.cats.txt"  # the file in which Blender looks for a library's catalogs
_HEADER = "# This is an Asset Catalog Definition file for Blender.\n\nVERSION 1\n\n"


def asset_file(folder: Path, name: str) -> Path:
    """Return the path of a run's asset file (.blend) in a batch's folder."""
    return folder / LIBRARY / f"{name}.blend"


def library_name(folder: Path) -> str:
    """Return the name of a batch's library in the asset browser."""
    return f"{folder.name} {LIBRARY}"


def write_asset(run: Path, picture: Path | None, file: Path) -> None:
    """Import a run folder and write it as an asset into a .blend file. This first replaces the open file by an empty one.

    The asset is the run's collection, without its cameras and light. `picture` becomes its preview. Raises InputError if the run cannot be
    read, or the .blend file cannot be written.
    """
    from .import_run import import_run
    from .run_parts import cameras
    from .world_light import correct_diffuse

    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    scene = bpy.context.scene
    collection = import_run(run, scene).collection
    if own := cameras(collection):
        bpy.data.batch_remove([*own.objects, own])
    if scene.world is not None:
        bpy.data.worlds.remove(scene.world)
    correct_diffuse(scene)  # the next scene has another world
    bpy.data.orphans_purge(do_recursive=True)
    bpy.ops.file.pack_all()
    collection.asset_mark()
    collection.asset_data.catalog_id = CATALOG_ID
    if picture is not None and picture.is_file():
        with bpy.context.temp_override(id=collection):
            bpy.ops.ed.lib_id_load_custom_preview(filepath=str(picture))
    with atomic_write(file) as temporary:
        # A whole file: Blender 4.3 leaves out the preview where `bpy.data.libraries.write` writes the collection alone.
        bpy.ops.wm.save_as_mainfile(filepath=str(temporary), compress=True, check_existing=False)


def add_catalog(library: Path) -> None:
    """Add the catalog "RefGS" to the folder `library` of an asset library. Catalogs that the artist added stay.

    Blender reads the catalogs of a library from a text file in its folder. Raises InputError if the file cannot be written.
    """
    file = library / _CATALOGS
    try:
        text = file.read_text(encoding="utf-8") if file.exists() else _HEADER
        if CATALOG_ID not in text:
            with atomic_write(file) as temporary:
                temporary.write_text(f"{text.rstrip()}\n{CATALOG_ID}:{CATALOG}:{CATALOG}\n", encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise unwritable(file, error) from None


def add_library(folder: Path) -> None:
    """Add a batch's library to Blender's asset libraries, unless it is listed there already."""
    preferences, path = bpy.context.preferences, (folder / LIBRARY).resolve()
    known = preferences.filepaths.asset_libraries
    if all(Path(bpy.path.abspath(library.path)).resolve() != path for library in known):
        known.new(name=library_name(folder), directory=str(path))
        preferences.is_dirty = True  # so that Blender saves them when it ends
