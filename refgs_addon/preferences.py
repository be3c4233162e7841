"""The add-on's preferences: the trainer, installed from here or in a Python of the artist's, and what is known of it."""

import textwrap
from pathlib import Path
from zlib import crc32

import bpy
from bpy.props import StringProperty

from . import installation, jobs
from .errors import InputError
from .job_timers import follow

PACKAGE = __package__.removesuffix(".refgs_addon")


def _chosen(self, context: bpy.types.Context) -> None:
    ask()


class Preferences(bpy.types.AddonPreferences):
    bl_idname = PACKAGE

    python: StringProperty(
        name="Python",
        description="The Python of an environment in which RefGS's trainer is installed, such as refgs/.venv/bin/python. "
        "Left empty, the trainer that is installed from here. Viewing, relighting and rendering do without",
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
        width = int(context.region.width / (6.2 * context.preferences.system.ui_scale)) - 6  # letters
        icon, text = state()
        lines(layout, text, width, icon)
        if set_up() and not installing():
            layout.operator("refgs.ask_trainer", text="Ask Again", icon="FILE_REFRESH")
        if _asked and _asked[0].state == "failed":
            layout.operator("wm.path_open", text="Open Log", icon="TEXT").filepath = str(_asked[0].log)
        _draw_installation(layout.box(), width)
        row = layout.row()
        row.enabled = not installing()
        row.use_property_split = True
        row.prop(self, "python", text="Or an Existing Python")
        row = layout.row()
        row.use_property_split = True
        row.prop(self, "hdris")


_asked: list[jobs.Job] = []  # the newest question to the Python that is used, or the installation, which asks as well


def preferences() -> Preferences:
    return bpy.context.preferences.addons[PACKAGE].preferences


def set_up() -> bool:
    """Whether there is a Python to ask."""
    addon = bpy.context.preferences.addons.get(PACKAGE)
    return addon is not None and bool(addon.preferences.python or installation.installed(home()))


def python() -> Path:
    """The Python that has the trainer. Raises InputError where there is none."""
    if preferences().python:
        return Path(bpy.path.abspath(preferences().python))
    if not set_up():
        raise InputError("no trainer is set up: install it, or choose its Python, in the add-on's preferences")
    return installation.python(home())


def home() -> Path:
    """Where the trainer is installed."""
    return _folder("trainer")


def hdri_folder() -> Path | None:
    """The artist's folder of panoramas, if one is chosen."""
    addon = bpy.context.preferences.addons.get(PACKAGE)
    return Path(bpy.path.abspath(addon.preferences.hdris)) if addon and addon.preferences.hdris else None


def log_file(name: str) -> Path:
    """Where a job's log is written."""
    return _folder("logs") / f"{name}.txt"


def capture_folder(capture: Path) -> Path:
    """Where a check writes what is shown of a capture."""
    return _folder("captures") / f"{capture.name} {crc32(str(capture).encode()):08x}"


def _folder(name: str) -> Path:
    """In the folder that Blender gives the add-on, which stays as releases come and go; temporary where it is no extension."""
    try:
        return Path(bpy.utils.extension_path_user(PACKAGE, path=name))
    except ValueError:
        return Path(bpy.app.tempdir) / name


def ask() -> None:
    """Ask the Python that is used for its trainer; `state` says what came of it."""
    forget()
    if set_up():
        _asked.append(jobs.ask(python(), log_file("trainer")))
        follow()


def install() -> None:
    """Install the trainer, or go on with that. Raises InputError where it cannot be."""
    if reason := why_no_installation() or installation.too_full(home()):
        raise InputError(reason)
    forget()
    _asked.append(jobs.install(home(), log_file("installation")))
    follow()


def remove() -> None:
    """Remove the trainer that was installed, or the half of it."""
    if reason := _in_use():
        raise InputError(reason)
    forget()
    _asked.append(jobs.remove(home(), log_file("installation")))
    follow()


def stop() -> None:
    """Stop the installation; it can be gone on with."""
    if job := installing():
        job.stop()
        job.line = "Stopping …"


def forget() -> None:
    """Ask no longer, and forget what was said."""
    for job in _asked:
        job.stop()
        if job in jobs.JOBS:
            jobs.JOBS.remove(job)
    _asked.clear()


def asked() -> list[jobs.Job]:
    """Jobs that are no artist's, but this page's."""
    return _asked


def installing() -> jobs.Job | None:
    """The installation, or the removal, that is going on."""
    return next((job for job in _asked if job.name in ("install", "remove") and not job.ended), None)


def state() -> tuple[str, str]:
    """An icon and a line about the trainer."""
    job = _asked[0] if _asked else None
    if job and job.state == "failed":
        return "ERROR", job.line[0].upper() + job.line[1:]
    if job and not job.ended:
        what = {"install": "The trainer is being installed", "remove": "The trainer is being removed"}
        return "SORTTIME", what.get(job.name, "Asking …")
    if not set_up():
        return (
            "INFO",
            "The trainer is not set up: install it, or choose a Python that has it",
        )
    if not job or not job.ready:
        return "QUESTION", "Not asked yet"
    trains_on = job.ready["card"] or f"the processor: {job.ready['no_card']}"
    return "CHECKMARK", f"RefGS {job.ready['refgs']}, training on {trains_on}"


def why_no_installation() -> str:
    """Why the trainer cannot be installed now: a line for the artist, or ""."""
    if not installation.brought():
        return "This copy of the add-on brings no trainer to install: choose a Python that has it"
    if preferences().python:
        return "A Python is chosen: empty its field to install the trainer here"
    if not bpy.app.online_access:
        return "Installing needs the network: allow online access in Preferences > System > Network"
    return _in_use()


def _in_use() -> str:
    busy = any(job not in _asked and not job.ended for job in jobs.JOBS)
    listed = (Path(known.folder) for scene in bpy.data.scenes for known in scene.refgs.runs)
    busy = busy or any(jobs.run_state(folder) == "training" for folder in listed)  # without this Blender
    return "The trainer is at work: wait for it, or stop it, first" if busy or installing() else ""


def _draw_installation(box: bpy.types.UILayout, width: int) -> None:
    if job := installing():
        box.progress(factor=job.part, text=f"{job.part:.0%}")
        lines(box, job.line, width)
        if job.name == "install":
            box.operator("refgs.stop_installing", text="Stop", icon="CANCEL")
        return
    there, brought = installation.installed(home()), installation.brought()
    begun = installation.begun(home())
    if there:
        lines(
            box,
            f"RefGS {there} is installed" + (f", this add-on brings {brought}" if brought not in ("", there) else ""),
            width,
        )
    elif begun:
        lines(
            box, "An installation was stopped halfway, and can be gone on with, unless another Blender is at it", width
        )
    elif brought:
        lines(box, f"The trainer can be installed: {installation.room(home())}", width)
    if there or begun or brought:
        lines(box, str(home()), width, "FILE_FOLDER")
    row = box.row(align=True)
    if not there or brought not in ("", there):
        text = f"Update to {brought}" if there else "Go On Installing" if begun else "Install the Trainer"
        row.operator("refgs.install_trainer", text=text, icon="IMPORT")
        if reason := why_no_installation():
            lines(box, reason, width, "INFO")
    if there or begun:
        row.operator("refgs.remove_trainer", text="Remove", icon="TRASH")


def lines(layout: bpy.types.UILayout, text: str, width: int, icon: str = "NONE") -> None:
    """A text on as many lines of so many letters as it takes."""
    column = layout.column(align=True)
    column.scale_y = 0.8
    for line in textwrap.wrap(text, max(width, 20), break_long_words=False, break_on_hyphens=False):
        column.label(text=line, icon=icon)
        icon = "NONE" if icon == "NONE" else "BLANK1"


CLASSES = (Preferences,)
