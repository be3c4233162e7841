"""Rendering in another Blender, so that this one stays free."""

import itertools
import sys
from collections.abc import Sequence
from pathlib import Path

import bpy

from .. import jobs
from ..errors import InputError
from ..job_timers import follow
from ..preferences import log_file

ROOT = Path(__file__).resolve().parents[2]  # where the package refgs_addon is
_START = "import sys; sys.path.insert(0, {root!r}); import refgs_addon.render_worker as background; background.main()"
_numbers = itertools.count()


def render_beside(
    scene: bpy.types.Scene, png: Path, hdris: Sequence[Path] | None = None, size: int | None = None, samples: int = 64
) -> jobs.Job:
    """Render what the scene's camera sees in Eevee, as the file is now, into a PNG, as `render_preview` does; with `hdris` a contact
    sheet, as `contact_sheet` does. In another process: the job says how far it is. Raises InputError where there is no camera or no folder
    to write to.
    """
    if scene.camera is None:
        raise InputError("there is no camera to look through: add one, or import a RefGS run with cameras.json")
    if not png.parent.is_dir():
        raise InputError(f"cannot write {png}: its folder is not there")
    copy = str(Path(bpy.app.tempdir) / f"refgs {next(_numbers)}.blend")  # Blender removes the folder when it ends
    _save_copy(copy)
    start = _START.format(root=str(ROOT))
    program, words = bpy.app.binary_path, ("--factory-startup", "--background", copy, "--python-expr", start)
    if not program:  # Blender as a Python module
        program, words = sys.executable, ("-c", f"import bpy; bpy.ops.wm.open_mainfile(filepath={copy!r}); {start}")
    command = {"command": "render", "png": str(png), "hdris": [str(file) for file in hdris or ()]}
    look = {"size": size, "samples": samples}
    job = jobs.render(Path(program), words, command | look, log_file(f"render {png.stem}"))
    follow()
    return job


def _save_copy(path: str) -> None:
    """Save the file as it is now elsewhere, without the picture of it that Blender would render for its file browser."""
    preferences = bpy.context.preferences
    kind, changed = preferences.filepaths.file_preview_type, preferences.is_dirty
    preferences.filepaths.file_preview_type = "NONE"
    try:
        bpy.ops.wm.save_as_mainfile(filepath=path, copy=True, check_existing=False)
    finally:
        preferences.filepaths.file_preview_type, preferences.is_dirty = kind, changed
