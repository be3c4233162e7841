"""Point the open file to a run folder that was moved, renamed or copied. Edits stay."""

import os
from pathlib import Path

import bpy
import numpy as np

from .. import blend_paths, jobs
from ..errors import InputError
from .edit import splats_of
from .run_parts import FOLDER
from .splat_cloud import read_splats


def find_run(old: Path, folder: Path) -> None:
    """Make `folder` a run's folder in place of the folder `old`. The run is imported, or only in the scenes' lists of runs.

    All paths in the open file that lead into the old folder lead into the new one afterwards, even if the old one still exists: those of
    the run's collection, of the recovered light and of the lists of runs. Other paths of the add-on, such as those of photos, are changed
    only if nothing is there any more, and it moved together with the run. The recovered light is packed into the .blend.

    Raises InputError if the new folder has no run, or not the splats that were imported. Then nothing changes.
    """
    folder = Path(os.path.abspath(folder))
    if not jobs.run_state(folder):
        raise InputError(f"{folder} is not a run: choose the folder that the training wrote")
    for collection in bpy.data.collections:
        if FOLDER in collection and Path(bpy.path.abspath(collection[FOLDER])) == old:
            _check_splats(collection, folder)

    def change(path: str) -> str:
        return _moved(path, old, folder)

    blend_paths.change_paths(change)
    for image in bpy.data.images:
        if image.source != "FILE" or image.library is not None:
            continue
        before = os.path.normpath(bpy.path.abspath(image.filepath))
        after = change(before)
        if after != before:
            image.filepath_raw = after
        if Path(after) == folder / "environment.exr" and not image.packed_file and os.path.isfile(after):
            image.reload()
            image.pack()
        elif after != before and not image.packed_file:
            image.reload()


def _check_splats(collection: bpy.types.Collection, folder: Path) -> None:
    """Raise InputError unless a run folder has the splats of an imported run, edited or not."""
    cloud, found = splats_of(collection).data, read_splats(folder / "splats.ply")[0]["opacity"]
    imported = np.empty(len(cloud.points), np.float32)
    cloud.attributes["opacity"].data.foreach_get("value", imported)
    if imported.shape != found.shape or not np.allclose(imported, found, atol=1e-5):
        raise InputError(f"{folder} is another run than {collection.name}: choose its own folder, or import this one")


def _moved(path: str, old: Path, new: Path) -> str:
    """Return where an absolute path leads after the folder `old` became `new`."""
    if not os.path.isabs(path):
        return path
    if Path(path).is_relative_to(old):
        return str(new / Path(path).relative_to(old))
    while old.name == new.name and old.name:  # then folders above may have moved, and others in them with the run
        old, new = old.parent, new.parent
    if Path(path).is_relative_to(old) and not os.path.exists(path):
        there = new / Path(path).relative_to(old)
        return str(there) if there.exists() else path
    return path
