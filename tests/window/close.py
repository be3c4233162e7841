"""Train in a Blender window, and close Blender with simulated key presses. test_window.py starts this script.

blender --enable-event-simulate --python close.py -- EXTENSION.zip PYTHON CAPTURE LETTER OUT
"""

import json
import shutil
import subprocess
import sys
import time
import traceback
from pathlib import Path

import bpy

ARCHIVE, PYTHON, CAPTURE, LETTER, OUT = sys.argv[sys.argv.index("--") + 1 :]
MODULE = "bl_ext.user_default.refgs"
PATIENCE = 180  # seconds
bpy.context.preferences.view.show_splash = False
report = {"states": []}


def job():
    return sys.modules[f"{MODULE}.refgs_addon.jobs"].JOBS[-1]


def press(letter, **held):
    window = bpy.context.window_manager.windows[0]
    x, y = window.width // 2, window.height // 2
    window.event_simulate(type="MOUSEMOVE", value="NOTHING", x=x, y=y)
    for value in ("PRESS", "RELEASE"):
        window.event_simulate(type=letter, value=value, x=x, y=y, **held)


def artist():
    """Train, then press the keys that close Blender. Yields conditions; each is awaited before the next step."""
    bpy.ops.extensions.package_install_files(filepath=ARCHIVE, repo="user_default", enable_on_install=True)
    bpy.context.preferences.addons[MODULE].preferences.python = PYTHON
    settings = bpy.context.scene.refgs
    settings.capture, settings.preset, settings.limited, settings.minutes = CAPTURE, "quick", True, 1.5
    yield lambda: True
    bpy.ops.refgs.train()
    bpy.ops.wm.save_as_mainfile(filepath=str(Path(OUT, "file.blend")))  # otherwise Blender asks to save
    yield lambda: job().progress
    press("Q", ctrl=True)
    yield lambda: True
    if shutil.which("import"):
        subprocess.run(["import", "-window", "root", str(Path(OUT, "asked.png"))], check=True)
    press("C")  # Cancel: its underlined letter
    yield lambda: True
    iteration = job().progress["iteration"]
    yield lambda: job().progress["iteration"] > iteration
    report["states"].append(job().state)
    press("Q", ctrl=True)
    yield lambda: True
    report["run"] = str(job().run)
    finish()
    press(LETTER)
    yield lambda: False


def finish():
    Path(OUT, "report.json").write_text(json.dumps(report))


steps, waiting, begun = artist(), None, 0.0


def tick() -> float | None:
    global waiting, begun
    try:
        if waiting is None or waiting():
            with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
                waiting, begun = next(steps), time.monotonic()
            return 1.0  # until Blender has handled the key
        assert time.monotonic() < begun + PATIENCE, "waited in vain"
    except Exception:
        report["error"] = traceback.format_exc()
        finish()
        bpy.ops.wm.quit_blender()
        return None
    return 0.2


bpy.app.timers.register(tick, first_interval=3.0)
