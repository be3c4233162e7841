"""The add-on's preferences: which Python has the trainer."""

from pathlib import Path

import bpy
from bpy.props import StringProperty

from . import jobs
from .errors import InputError
from .follow import follow

PACKAGE = __package__.removesuffix(".refgs_addon")


def _chosen(self, context: bpy.types.Context) -> None:
    ask()


class Preferences(bpy.types.AddonPreferences):
    bl_idname = PACKAGE

    python: StringProperty(
        name="Python",
        description="The Python of an environment in which RefGS's trainer is installed, such as refgs/.venv/bin/python. "
        "Viewing, relighting and rendering do without",
        subtype="FILE_PATH",
        update=_chosen,
    )
    hdris: StringProperty(
        name="HDRIs",
        description="A folder of your own panoramas (EXR or HDR), shown beside those that come with Blender",
        subtype="DIR_PATH",
    )

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "python")
        icon, text = state()
        row = layout.row()
        row.label(text=text, icon=icon)
        row.operator("refgs.ask_trainer", text="Ask Again", icon="FILE_REFRESH")
        layout.prop(self, "hdris")


_asked: list[jobs.Job] = []  # the newest question to the Python that is chosen


def preferences() -> Preferences:
    return bpy.context.preferences.addons[PACKAGE].preferences


def is_set_up() -> bool:
    """Whether a Python with the trainer is chosen."""
    addon = bpy.context.preferences.addons.get(PACKAGE)
    return addon is not None and bool(addon.preferences.python)


def python() -> Path:
    """The Python that has the trainer. Raises InputError where none is chosen."""
    chosen = preferences().python
    if not chosen:
        raise InputError("no trainer is set up: choose its Python in the add-on's preferences")
    return Path(bpy.path.abspath(chosen))


def hdri_folder() -> Path | None:
    """The artist's folder of panoramas, if one is chosen."""
    addon = bpy.context.preferences.addons.get(PACKAGE)
    return Path(bpy.path.abspath(addon.preferences.hdris)) if addon and addon.preferences.hdris else None


def log_file(name: str) -> Path:
    """Where a job's log is written, in the folder that Blender gives the add-on; temporary where it is no extension."""
    try:
        folder = bpy.utils.extension_path_user(PACKAGE, path="logs", create=True)
    except ValueError:
        folder = bpy.app.tempdir
    return Path(folder) / f"{name}.txt"


def ask() -> jobs.Job | None:
    """Ask the chosen Python for its trainer; `state` says what came of it."""
    for job in _asked:
        job.stop()
        if job in jobs.JOBS:
            jobs.JOBS.remove(job)
    _asked.clear()
    if not preferences().python:
        return None
    _asked.append(jobs.ask(python(), log_file("trainer")))
    follow()
    return _asked[0]


def asked() -> list[jobs.Job]:
    """Jobs that are no artist's, but this page's."""
    return _asked


def state() -> tuple[str, str]:
    """An icon and a line about the trainer."""
    if not preferences().python:
        return "INFO", "The trainer is not set up: choose the Python that it is installed in"
    job = _asked[0] if _asked else None
    if job is None:
        return "QUESTION", "Not asked yet"
    if job.state == "failed":
        return "ERROR", job.line[0].upper() + job.line[1:]
    if not job.ended:
        return "SORTTIME", "Asking …"
    trains_on = job.ready["card"] or f"the processor: {job.ready['no_card']}"
    return "CHECKMARK", f"RefGS {job.ready['refgs']}, training on {trains_on}"


CLASSES = (Preferences,)
