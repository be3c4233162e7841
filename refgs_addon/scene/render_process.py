"""Render, or do other slow work, in another Blender process, so that the artist can continue in this one."""

import itertools
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import bpy

from .. import jobs
from ..errors import InputError
from ..job_timers import follow_jobs
from ..preferences import log_file

ROOT = Path(__file__).resolve().parents[2]  # contains the package refgs_addon
# The other Blender knows none of this one's repositories of extensions: add a repository for it that contains this add-on's code.
_START = """
import bpy, importlib
repository = bpy.context.preferences.extensions.repos.new(name="RefGS", module="refgs", custom_directory={root!r})
importlib.import_module("bl_ext." + repository.module + ".refgs_addon.render_worker").main()
"""
_numbers = itertools.count()


def render_in_background(
    scene: bpy.types.Scene, png: Path, hdris: Sequence[Path] | None = None, size: int | None = None, samples: int = 64
) -> jobs.Job:
    """Start a job that renders the scene camera's view in another Blender process, from a copy of the open file. Returns the job.

    Without `hdris` the PNG is what `render_preview` renders; with `hdris` it is what `contact_sheet` renders. Raises InputError if there is
    no camera, or the PNG's folder does not exist.
    """
    if scene.camera is None:
        raise InputError("there is no camera to look through: add one, or import a RefGS run with cameras.json")
    if not png.parent.is_dir():
        raise InputError(f"cannot write {png}: its folder does not exist")
    copy = str(Path(bpy.app.tempdir) / f"refgs {next(_numbers)}.blend")  # Blender deletes the folder when it ends
    _save_copy(copy)
    command = {"command": "render", "png": str(png), "hdris": [str(file) for file in hdris or ()]}
    return start_blender(png.name, f"render {png.stem}", command | {"size": size, "samples": samples}, copy)


def start_blender(name: str, log: str, command: Mapping[str, object], file: str | None = None) -> jobs.Job:
    """Start a job in another Blender process. That Blender opens `file`, a .blend, if it is given.

    `name` names the job, and `log` names its log file. `command` tells the process what to do; the module `render_worker` lists the
    commands.
    """
    start = _START.format(root=str(ROOT))
    words = ("--factory-startup", "--background", *([file] if file else []), "--python-expr", start)
    program = bpy.app.binary_path
    if not program:  # Blender runs as a Python module
        opened = f"bpy.ops.wm.open_mainfile(filepath={file!r}); " if file else ""
        program, words = sys.executable, ("-c", f"import bpy; {opened}\n{start}")
    job = jobs.in_blender(name, Path(program), words, command, log_file(log))
    follow_jobs()
    return job


def _save_copy(path: str) -> None:
    """Save a copy of the open file without a thumbnail."""
    preferences = bpy.context.preferences
    kind, changed = preferences.filepaths.file_preview_type, preferences.is_dirty
    preferences.filepaths.file_preview_type = "NONE"
    try:
        bpy.ops.wm.save_as_mainfile(filepath=path, copy=True, check_existing=False)
    finally:
        preferences.filepaths.file_preview_type, preferences.is_dirty = kind, changed
