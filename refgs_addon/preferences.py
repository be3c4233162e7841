"""Show the add-on's preferences: install the trainer or choose a Python that has it, and see the trainer's status."""

import textwrap
from pathlib import Path
from zlib import crc32

import bpy
from bpy.props import StringProperty

from . import installation, jobs
from .errors import InputError
from .job_timers import follow_jobs

PACKAGE = __package__.removesuffix(".refgs_addon")


def _chosen(self, context: bpy.types.Context) -> None:
    query_trainer()


class Preferences(bpy.types.AddonPreferences):
    bl_idname = PACKAGE

    python: StringProperty(
        name="Python",
        description="Python of an environment that has RefGS's trainer, such as refgs/.venv/bin/python. "
        "If left empty, the trainer installed above is used. Viewing, relighting and rendering need no trainer",
        subtype="FILE_PATH",
        update=_chosen,
    )
    hdris: StringProperty(
        name="HDRIs",
        description="Folder with your own panoramas (EXR or HDR), shown beside those that come with Blender",
        subtype="DIR_PATH",
    )
    mask_model: StringProperty(
        name="Mask Model",
        description="ONNX file of a model that segments salient objects, such as BiRefNet. "
        "If left empty, Make Masks uses the model that comes with RefGS",
        subtype="FILE_PATH",
    )

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        width = int(context.region.width / (6.2 * context.preferences.system.ui_scale)) - 6  # letters
        icon, text = status()
        wrapped_text(layout, text, width, icon)
        if set_up() and not installing():
            layout.operator("refgs.ask_trainer", text="Query Again", icon="FILE_REFRESH")
        if _own_jobs and _own_jobs[0].state == "failed":
            layout.operator("wm.path_open", text="Open Log", icon="TEXT").filepath = str(_own_jobs[0].log)
        _draw_installation(layout.box(), width)
        row = layout.row()
        row.enabled = not installing()
        row.use_property_split = True
        row.prop(self, "python", text="Or an Existing Python")
        column = layout.column()
        column.use_property_split = True
        column.prop(self, "hdris")
        column.prop(self, "mask_model")


_own_jobs: list[jobs.Job] = []  # the newest query or installation; at most one


def preferences() -> Preferences:
    return bpy.context.preferences.addons[PACKAGE].preferences


def set_up() -> bool:
    """Check whether the trainer is installed, or the artist has chosen a Python for it."""
    addon = bpy.context.preferences.addons.get(PACKAGE)
    return addon is not None and bool(addon.preferences.python or installation.installed(home()))


def python() -> Path:
    """Return the path of the trainer's Python. Raises InputError where there is none."""
    if preferences().python:
        return Path(bpy.path.abspath(preferences().python))
    if not set_up():
        raise InputError("no trainer is set up: install it, or choose its Python, in the add-on's preferences")
    return installation.python(home())


def home() -> Path:
    """Return the folder in which the add-on installs the trainer."""
    return _folder("trainer")


def hdri_folder() -> Path | None:
    """Return the folder of the artist's panoramas, or None if none is chosen."""
    addon = bpy.context.preferences.addons.get(PACKAGE)
    return Path(bpy.path.abspath(addon.preferences.hdris)) if addon and addon.preferences.hdris else None


def mask_model() -> Path | None:
    """Return the path of the artist's own ONNX model for masks, or None."""
    return Path(bpy.path.abspath(preferences().mask_model)) if preferences().mask_model else None


def log_file(name: str) -> Path:
    """Return the path of the log of the job `name`."""
    return _folder("logs") / f"{name}.txt"


def capture_folder(capture: Path) -> Path:
    """Return the folder into which the check of a capture writes cameras.json and thumbnails."""
    return _folder("captures") / f"{capture.name} {crc32(str(capture).encode()):08x}"


def hints_file(run: Path) -> Path:
    """Return the path of a run's hints: a file that says which parts of the object are metal or paint. `run` is the run folder.

    The file stays when Blender closes, because the training may read it later.
    """
    return _folder("hints") / f"{run.name} {crc32(str(run).encode()):08x}.json"


def _folder(name: str) -> Path:
    """Return the path of the folder `name` for data that updates of the add-on keep."""
    try:
        return Path(bpy.utils.extension_path_user(PACKAGE, path=name))
    except ValueError:
        return Path(bpy.app.tempdir) / name


def query_trainer() -> None:
    """Start a job that asks the trainer for the version and GPU that `status` shows."""
    forget_queries()
    if set_up():
        _own_jobs.append(jobs.query_trainer(python(), log_file("trainer")))
        follow_jobs()


def install() -> None:
    """Install the trainer, or resume an interrupted installation. Raises InputError where installing is impossible."""
    if reason := installation_problem() or installation.disk_full_line(home()):
        raise InputError(reason)
    forget_queries()
    _own_jobs.append(jobs.install(home(), log_file("installation")))
    follow_jobs()


def remove() -> None:
    """Remove the installed trainer, even an incomplete one. Raises InputError while the trainer runs."""
    if reason := _busy_line():
        raise InputError(reason)
    forget_queries()
    _own_jobs.append(jobs.remove(home(), log_file("installation")))
    follow_jobs()


def stop() -> None:
    """Stop the running installation. It can be resumed later."""
    if job := installing():
        job.stop()
        job.line = "Stopping …"


def forget_queries() -> None:
    """Stop and forget the job that the preferences started, if any."""
    for job in _own_jobs:
        job.stop()
        if job in jobs.JOBS:
            jobs.JOBS.remove(job)
    _own_jobs.clear()


def own_jobs() -> list[jobs.Job]:
    """List the jobs that the preferences started. The Train panel does not show these jobs."""
    return _own_jobs


def installing() -> jobs.Job | None:
    """Return the job that installs or removes the trainer, or None while none runs."""
    return next((job for job in _own_jobs if job.name in ("install", "remove") and not job.ended), None)


def status() -> tuple[str, str]:
    """Describe the trainer's status by an icon's name and a line for the artist."""
    job = _own_jobs[0] if _own_jobs else None
    if job and job.state == "failed":
        return "ERROR", job.line[0].upper() + job.line[1:]
    if job and not job.ended:
        what = {"install": "The trainer is being installed", "remove": "The trainer is being removed"}
        return "SORTTIME", what.get(job.name, "Querying …")
    if not set_up():
        return "INFO", "The trainer is not set up: install it, or choose a Python that has it"
    if not job or not job.ready:
        return "QUESTION", "The trainer was not queried yet"
    trains_on = job.ready["card"] or f"the processor: {job.ready['no_card']}"
    return "CHECKMARK", f"RefGS {job.ready['refgs']}, training on {trains_on}"


def installation_problem() -> str:
    """Return why the trainer cannot be installed now, or "" if it can."""
    if not installation.bundled_version():
        return "This copy of the add-on contains no trainer: choose a Python that has it"
    if preferences().python:
        return "A Python is chosen: clear its field to install the trainer here"
    if not bpy.app.online_access:
        return "Installing needs the network: allow online access in Preferences > System > Network"
    return _busy_line()


def _busy_line() -> str:
    busy = any(job not in _own_jobs and not job.ended for job in jobs.JOBS)
    listed = (Path(known.folder) for scene in bpy.data.scenes for known in scene.refgs.runs)
    busy = busy or any(jobs.run_state(folder) == "training" for folder in listed)  # in another process
    return "The trainer is running: wait for it or stop it first" if busy or installing() else ""


def _draw_installation(box: bpy.types.UILayout, width: int) -> None:
    if job := installing():
        box.progress(factor=job.fraction, text=f"{job.fraction:.0%}")
        wrapped_text(box, job.line, width)
        if job.name == "install":
            box.operator("refgs.stop_installing", text="Stop", icon="CANCEL")
        return
    there, bundled = installation.installed(home()), installation.bundled_version()
    interrupted, outdated = installation.interrupted(home()), bundled not in ("", there)
    if there:
        wrapped_text(box, f"RefGS {there} is installed{f', this add-on contains {bundled}' if outdated else ''}", width)
        wrapped_text(box, installation.origin(home()), width)
    elif interrupted:
        text = "An installation was interrupted. Resume it, unless another Blender is running it"
        wrapped_text(box, text, width)
    elif bundled:
        wrapped_text(box, f"The trainer can be installed: {installation.space_line(home())}", width)
    if there or interrupted or bundled:
        wrapped_text(box, str(home()), width, "FILE_FOLDER")
    row = box.row(align=True)
    if not there or outdated:
        text = f"Update to {bundled}" if there else "Resume Installation" if interrupted else "Install the Trainer"
        row.operator("refgs.install_trainer", text=text, icon="IMPORT")
        if reason := installation_problem():
            wrapped_text(box, reason, width, "INFO")
    if there or interrupted:
        row.operator("refgs.remove_trainer", text="Remove", icon="TRASH")


def letters(context: bpy.types.Context) -> int:
    """Return how many letters fit into a line of the sidebar that is drawn."""
    return int(context.region.width / (7 * context.preferences.system.ui_scale)) - 6


def wrapped_text(layout: bpy.types.UILayout, text: str, width: int, icon: str = "NONE") -> None:
    """Draw a text on lines of at most `width` letters."""
    column = layout.column(align=True)
    column.scale_y = 0.8
    width = max(width - (0 if icon == "NONE" else 3), 20)
    for line in textwrap.wrap(text, width, break_on_hyphens=False):
        column.label(text=line, icon=icon)
        icon = "NONE" if icon == "NONE" else "BLANK1"


CLASSES = (Preferences,)
