"""Act as an artist in a Blender window: make a capture of a film, mask it, paint a stroke, train and import the run.

Arguments: the Python with the trainer, and the film. stage.py shows the command line.
"""

import importlib.util
from pathlib import Path

import bpy
from stage import WORDS, act, after, area, choose_tab, install, jobs, photograph, report, set_python, view

PYTHON, FILM = WORDS


def ended():
    return bool(jobs()) and jobs()[-1].ended


def stroke(canvas):
    """Paint a black stroke on a canvas that the image editor shows. Yields as `artist` does.

    Its pixels are written: Debian's Blender comes without brushes.
    """
    import numpy as np

    editors = [area for window in bpy.context.window_manager.windows for area in window.screen.areas]
    editor = next(area for area in editors if area.type == "IMAGE_EDITOR")
    report["editor"] = editor.spaces.active.ui_mode, editor.spaces.active.image.name
    bpy.ops.refgs.choose_brush(paints="rest")
    width, height = canvas.size
    pixels = np.empty(width * height * 4, np.float32)
    canvas.pixels.foreach_get(pixels)
    pixels.reshape(height, width, 4)[height // 2 - 8 : height // 2 + 8, width // 2 : width * 3 // 4] = 0, 0, 0, 1
    canvas.pixels.foreach_set(pixels)
    canvas.update()
    yield after(3.0)
    photograph("stroke")
    yield lambda: True


def artist():
    """Press the buttons from a film to an imported run.

    Each `yield` gives a function; the next step waits until this function returns true.
    """
    install()
    area().spaces.active.show_region_ui = True
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    set_python(PYTHON)
    settings = bpy.context.scene.refgs
    yield after(1.0)
    choose_tab()
    yield ended
    bpy.ops.refgs.photos_from_video(filepath=FILM, count=24)
    yield lambda: jobs()[-1].progress
    yield ended
    yield after(1.0)
    photograph("photos")
    report["capture"], report["line"] = settings.capture, jobs()[-1].line
    bpy.ops.refgs.find_cameras()
    yield ended
    report["placed"] = jobs()[-1].results["poses"]["placed"]
    for job in jobs()[1:]:
        bpy.ops.refgs.put_away(serial=job.serial)
    bpy.ops.refgs.make_masks()
    yield ended
    report["masks"] = jobs()[-1].results["masks"]["made"]
    report["cameras"] = sum(item.type == "CAMERA" for item in bpy.data.objects) - 1  # without Blender's default camera
    report["box"] = list(settings.region.scale)
    with view():
        bpy.ops.view3d.view_all()
    yield after(3.0)
    photograph("masks")
    report["numpy"] = importlib.util.find_spec("numpy") is not None
    if not report["numpy"]:
        return
    bpy.context.view_layer.objects.active = next(
        item for item in bpy.data.objects if item.data and "refgs_photo" in item.data
    )
    bpy.ops.refgs.paint_strokes()
    yield after(3.0)
    canvas = next(image for image in bpy.data.images if "refgs_strokes" in image)
    yield from stroke(canvas)
    bpy.ops.refgs.save_strokes()
    report["strokes"] = canvas["refgs_strokes"]
    yield ended
    yield after(3.0)
    photograph("corrected")
    report["corrected"] = jobs()[-1].line or jobs()[-1].state
    settings.limited, settings.minutes = True, 0.3
    bpy.ops.refgs.train()
    yield ended
    report["trained"], run = jobs()[-1].state, Path(jobs()[-1].run)
    report["run"] = str(run)
    report["imported"] = list(bpy.ops.refgs.import_trained(folder=str(run)))
    area().spaces.active.shading.type = "MATERIAL"
    with view():
        bpy.ops.view3d.view_all()
    yield after(10.0)
    photograph("imported")


act(artist())
