"""Read and draw the preferences of the trainer's extension: install the trainer or choose a Python that has it, and see its status."""

from pathlib import Path
from zlib import crc32

import bpy

from .. import jobs
from ..errors import InputError
from ..job_timers import follow_jobs
from ..preferences import log_file, user_folder, wrapped_text
from . import commands, installation

PACKAGE = ""  # the trainer's extension, which has the preferences; `register` sets it

_own_jobs: list[jobs.Job] = []  # the newest query or installation; at most one


def preferences() -> bpy.types.AddonPreferences:
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
        raise InputError("no trainer is set up: install it, or choose its Python, in the preferences of RefGS Trainer")
    return installation.python(home())


def home() -> Path:
    """Return the folder in which the trainer is installed.

    Releases that were one extension installed it in the folder of RefGS: what is there is used, and can be updated and removed.
    """
    before = user_folder("trainer")
    return before if before.is_dir() else _folder("trainer")


def _folder(name: str) -> Path:
    return user_folder(name, PACKAGE)


def mask_model() -> Path | None:
    """Return the path of the artist's own ONNX model for masks, or None."""
    return Path(bpy.path.abspath(preferences().mask_model)) if preferences().mask_model else None


def capture_folder(capture: Path) -> Path:
    """Return the folder into which the check of a capture writes cameras.json and thumbnails."""
    return _folder("captures") / f"{capture.name} {crc32(str(capture).encode()):08x}"


def hints_file(run: Path) -> Path:
    """Return the path of a run's hints: a file that says which parts of the object are metal or paint. `run` is the run folder.

    The file stays when Blender closes, because the training may read it later.
    """
    return _folder("hints") / f"{run.name} {crc32(str(run).encode()):08x}.json"


def query_trainer() -> None:
    """Start a job that asks the trainer for the version and GPU that `status` shows."""
    forget_queries()
    if set_up():
        _own_jobs.append(commands.query_trainer(python(), log_file("trainer")))
        follow_jobs()


def install() -> None:
    """Install the trainer, or resume an interrupted installation. Raises InputError where installing is impossible."""
    if reason := installation_problem() or installation.disk_full_line(home()):
        raise InputError(reason)
    forget_queries()
    _own_jobs.append(commands.install(home(), log_file("installation")))
    follow_jobs()


def remove() -> None:
    """Remove the installed trainer, even an incomplete one. Raises InputError while the trainer runs."""
    if reason := _busy_line():
        raise InputError(reason)
    forget_queries()
    _own_jobs.append(commands.remove(home(), log_file("installation")))
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
        return "This copy of RefGS Trainer contains no trainer: choose a Python that has it"
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


def draw(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the trainer's status, its installation and the preferences."""
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
    row.prop(preferences(), "python", text="Or an Existing Python")
    column = layout.column()
    column.use_property_split = True
    column.prop(preferences(), "mask_model")


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


def register(package: str) -> None:
    global PACKAGE
    PACKAGE = package


def unregister() -> None:
    forget_queries()
