"""Train in a Blender window, then close Blender with simulated key presses. test_window.py starts this script.

Arguments: the Python with the trainer, the capture, and the letter key that answers the closing dialogue. stage.py shows the command line.
"""

import bpy
from stage import OUT, WORDS, act, install, jobs, photograph, press, report, set_python, write_report

PYTHON, CAPTURE, LETTER = WORDS


def type_key(key, **held):
    window = bpy.context.window_manager.windows[0]
    press(key, window.width // 2, window.height // 2, **held)


def artist():
    """Train, then press the keys that close Blender.

    Each `yield` gives a function; the next step waits until this function returns true.
    """
    install()
    set_python(PYTHON)
    settings = bpy.context.scene.refgs
    settings.capture, settings.preset, settings.limited, settings.minutes = CAPTURE, "quick", True, 1.5
    yield lambda: True
    bpy.ops.refgs.train()
    bpy.ops.wm.save_as_mainfile(filepath=str(OUT / "file.blend"))  # otherwise Blender asks to save
    yield lambda: jobs()[-1].progress
    type_key("Q", ctrl=True)
    yield lambda: True
    photograph("asked")
    type_key("C")  # Cancel: its underlined letter
    yield lambda: True
    iteration = jobs()[-1].progress["iteration"]
    yield lambda: jobs()[-1].progress["iteration"] > iteration
    report["states"] = [jobs()[-1].state]
    type_key("Q", ctrl=True)
    yield lambda: True
    report["run"] = str(jobs()[-1].run)
    write_report()
    type_key(LETTER)
    yield lambda: False


act(artist())
