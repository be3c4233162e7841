"""Provide functions for the scripts that run in a Blender window: install the extensions, take screenshots, write a report.

blender --python-expr "import sys; sys.path.append(FOLDER)" --python SCRIPT.py -- REPOSITORY [ARGUMENT ...] OUT

REPOSITORY is a folder with the extensions' zips and the index.json that Blender generated of them.
"""

import importlib
import json
import shutil
import subprocess
import sys
import time
import traceback
from pathlib import Path

import bpy

REPOSITORY, *WORDS, OUT = sys.argv[sys.argv.index("--") + 1 :]
OUT = Path(OUT)
MODULE, TRAINER = "bl_ext.refgs_host.refgs", "bl_ext.refgs_host.refgs_trainer"
PATIENCE = 180  # seconds, for a machine that is busy
bpy.context.preferences.view.show_splash = False
report = {}


def install(*names):
    """Install extensions from the repository, as an artist does who has added it in the preferences. By default, both."""
    repositories = bpy.context.preferences.extensions.repos
    if "refgs_host" not in [repository.module for repository in repositories]:
        repositories.new(name="RefGS", module="refgs_host", remote_url=Path(REPOSITORY, "index.json").as_uri())
    number = [repository.module for repository in repositories].index("refgs_host")
    system = bpy.context.preferences.system
    system.use_online_access = True  # Blender asks for it even where the repository is a folder
    bpy.ops.extensions.repo_sync(repo_index=number)
    for name in names or ("refgs", "refgs_trainer"):
        bpy.ops.extensions.package_install(repo_index=number, pkg_id=name, enable_on_install=True)
    system.use_online_access = False


def set_python(file):
    """Choose the Python that has the trainer."""
    bpy.context.preferences.addons[TRAINER].preferences.python = str(file)


def addon(name):
    """Return a module of the add-on, such as "scene.hints"."""
    return importlib.import_module(f"{MODULE}.refgs_addon.{name}")


def panels():
    """List the panels of both extensions."""
    classes = [*addon("ui").CLASSES, *addon("trainer.ui").CLASSES]
    return [cls for cls in classes if issubclass(cls, bpy.types.Panel)]


def jobs():
    """Return the add-on's list of jobs."""
    return addon("jobs").JOBS


def area():
    """Return the window's 3D view."""
    return next(area for area in bpy.context.window_manager.windows[0].screen.areas if area.type == "VIEW_3D")


def region(kind):
    """Return a region of the 3D view: "UI" is the sidebar, "WINDOW" the view itself."""
    return next(region for region in area().regions if region.type == kind)


def view():
    """Return a context manager that makes the 3D view the context of operators, as for a button in the sidebar."""
    return bpy.context.temp_override(area=area(), region=region("WINDOW"))


def choose_tab():
    region("UI").active_panel_category = "RefGS"
    area().tag_redraw()


def hover(x, y):
    """Move the mouse. `x` and `y` count pixels from the lower left corner of the window."""
    bpy.context.window_manager.windows[0].event_simulate(type="MOUSEMOVE", value="NOTHING", x=x, y=y)


def press(key, x, y, **held):
    """Move the mouse and press a key or button. `held` are the other keys that are down, such as ctrl=True."""
    hover(x, y)
    for value in ("PRESS", "RELEASE"):
        bpy.context.window_manager.windows[0].event_simulate(type=key, value=value, x=x, y=y, **held)


def click(x, y):
    press("LEFTMOUSE", x, y)


def photograph(name):
    """Save a screenshot of the window as NAME.png."""
    # Blender's own screenshot reads a front buffer, which is black on a virtual screen; ImageMagick reads the screen.
    if shutil.which("import"):
        subprocess.run(["import", "-window", "root", str(OUT / f"{name}.png")], check=True)
    else:
        bpy.ops.screen.screenshot(filepath=str(OUT / f"{name}.png"))


def write_report():
    (OUT / "report.json").write_text(json.dumps(report))


def quit_blender():
    write_report()
    bpy.ops.wm.quit_blender()


def after(seconds):
    """Return a function that returns true once `seconds` have passed."""
    due = time.monotonic() + seconds
    return lambda: time.monotonic() >= due


def act(steps, pause=1.0):
    """Run a script's steps in the window. `steps` is a generator that yields conditions: functions that are called
    again and again until they return true, first after `pause` seconds. Then the generator runs on to the next condition.

    Blender quits after the last step, after an error, or if a wait takes longer than PATIENCE seconds.
    """
    waiting, begun = None, 0.0

    def tick() -> float | None:
        nonlocal waiting, begun
        try:
            if waiting is None or waiting():
                with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
                    waiting, begun = next(steps), time.monotonic()
                return pause  # until Blender has handled the key
            assert time.monotonic() < begun + PATIENCE, "waited in vain"
        except StopIteration:
            return quit_blender()
        except Exception:
            report["error"] = traceback.format_exc()
            return quit_blender()
        return min(pause, 0.2)

    bpy.app.timers.register(tick, first_interval=3.0)
