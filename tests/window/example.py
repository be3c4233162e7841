"""Click on Import Example in an empty file, without the trainer. Report what came of it.

stage.py shows the command line.
"""

import shutil

import bpy
from hands import choose_tab, press, push
from stage import act, after, area, install, photograph, report


def artist():
    """Install RefGS alone, empty the file, and click. Each `yield` gives a function; the next step waits until it returns true."""
    report["xdotool"] = shutil.which("xdotool") is not None
    if not report["xdotool"]:
        return
    bpy.context.preferences.system.use_region_overlap = False  # else each look for a button draws the 3D view again
    install("refgs")
    yield after(1.0)
    for key in ("a", "Delete", "n"):
        yield from press(key, 600, 480)
    yield from choose_tab()
    photograph("empty")
    yield from push("refgs.import_example")
    yield lambda: bpy.context.view_layer.objects.active is not None
    report["active"], report["shading"] = bpy.context.view_layer.objects.active.name, area().spaces.active.shading.type
    yield after(10.0)  # to compile shaders
    photograph("example")


act(artist(), pause=0.02)
