"""Read the table that a batch writes, with a row for each run, and copy it into the panel's list.

A batch trains all captures of a folder (`scene.many`).
"""

import math
from pathlib import Path
from typing import NamedTuple

import bpy
from bpy.props import CollectionProperty, IntProperty, StringProperty

from ... import jobs
from ...errors import InputError
from ...json_file import read_json

ROWS = "rows.json"  # in the batch's LOGS, as in backend/refgs/batch/batch.py
LOG, PICTURE = (".log", ".txt"), (".png",)
_STEPS = {
    "poses": "finding cameras",
    "masks": "making masks",
    "train": "training",
    "evaluate": "measuring",
    "export": "making the mesh",
}

# The folder whose table the panel has, and what tells the table's versions apart.
_shown: tuple[Path, object] | None = None


class Row(NamedTuple):
    """Hold the row about one run in a batch's table. `state` is "waiting", "running", "done", "failed" or "stopped".

    `words` is the progress or the result in a few words, such as "training, 42 %" or "31.2 dB, 3.4 min". `what` says which step failed and
    why. `log` and `picture` are paths of files in the batch's folder, or "" without such a file.
    """

    name: str
    state: str
    words: str
    what: str
    log: str
    picture: str


def read_rows(folder: Path) -> list[Row]:
    """Read the table of a batch. `folder` is the folder of the batch's runs. Returns [] if no batch was started there.

    Damaged rows are left out. If no process works on the batch any more, runs that have not ended are "stopped".
    """
    try:
        found = read_json(folder / jobs.LOGS / ROWS)["rows"]
    except (InputError, KeyError, TypeError):
        return []
    going, rows = jobs.run_state(folder / jobs.LOGS) == "training", []
    for facts in found if isinstance(found, list) else ():
        try:
            name, state, what = (str(facts[key]) for key in ("name", "state", "what"))
            if state in ("waiting", "running") and not going:
                state = "stopped"
            files = (_inside(folder, facts[key], endings) for key, endings in (("log", LOG), ("picture", PICTURE)))
            rows.append(Row(name, state, _words(state, facts), what, *files))
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
            continue
    return rows


def _inside(folder: Path, path: object, endings: tuple[str, ...]) -> str:
    """Return `path` if it is a file in `folder` with an allowed suffix, else "".

    The panel opens it: a damaged table must not make it run any program.
    """
    file = Path(str(path or "")).resolve()
    known = file.is_relative_to(folder.resolve()) and file.suffix.lower() in endings and file.is_file()
    return str(path) if known else ""


def _words(state: str, facts: dict) -> str:
    """Describe a run, such as "training, 42 %" or "31.2 dB, 3.4 min"."""
    if state == "running":
        part = facts["part"]
        step = _STEPS.get(facts["step"], str(facts["step"]))
        return step if part is None else f"{step}, {float(part):.0%}"
    if state != "done":
        return state
    figures, minutes = facts["figures"], float(facts["seconds"]) / 60
    psnr = float(figures["psnr"]) if "psnr" in figures else math.nan
    return f"{psnr:.1f} dB, {minutes:.1f} min" if math.isfinite(psnr) else f"{minutes:.1f} min"


def show_table(folder: Path) -> bool:
    """Show a batch's table in the panel's list, and return True if it has changed."""
    global _shown
    try:
        changed = (folder / jobs.LOGS / ROWS).stat().st_mtime_ns
    except OSError:
        changed = 0
    version = folder, (changed, jobs.run_state(folder / jobs.LOGS))
    if version == _shown:
        return False
    manager = bpy.context.window_manager
    chosen = row.name if (row := chosen_row(folder)) is not None else ""
    _shown, listed = version, manager.refgs_rows
    listed.clear()
    for row in read_rows(folder):
        item = listed.add()
        for key, value in row._asdict().items():
            setattr(item, key, value)
    names = [item.name for item in listed]
    manager.refgs_row = names.index(chosen) if chosen in names else 0
    return True


def is_shown(folder: Path) -> bool:
    """Return whether the panel's list has the rows of the batch in this folder."""
    return _shown is not None and _shown[0] == folder


def chosen_row(folder: Path) -> bpy.types.PropertyGroup | None:
    """Return the row of a batch that is selected in the panel's list, or None."""
    manager = bpy.context.window_manager
    rows = manager.refgs_rows if is_shown(folder) else ()
    return rows[manager.refgs_row] if 0 <= manager.refgs_row < len(rows) else None


class BatchRow(bpy.types.PropertyGroup):
    """Hold a row of the table of a batch, with the fields of `Row`."""

    name: StringProperty()
    state: StringProperty()
    words: StringProperty()
    what: StringProperty()
    log: StringProperty()
    picture: StringProperty()


CLASSES = (BatchRow,)


def register() -> None:
    bpy.types.WindowManager.refgs_rows = CollectionProperty(type=BatchRow)
    bpy.types.WindowManager.refgs_row = IntProperty(name="Run", description="Selected run of the batch")


def unregister() -> None:
    global _shown
    _shown = None
    del bpy.types.WindowManager.refgs_rows, bpy.types.WindowManager.refgs_row
