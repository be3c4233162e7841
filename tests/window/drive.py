"""Install the extension in a Blender window, open its tab, take a screenshot and write a report.

Its argument is the run folder. stage.py shows the command line.
"""

import importlib.util

import bpy
from stage import MODULE, WORDS, act, after, area, choose_tab, install, photograph, report, view

(RUN,) = WORDS


def artist():
    """Install the extension, import a run, open the tab and disable the extension.

    Each `yield` gives a function; the next step waits until this function returns true.
    """
    report["numpy"], drawn = importlib.util.find_spec("numpy") is not None, set()
    install()
    report["enabled"] = MODULE in bpy.context.preferences.addons
    for panel in ("REFGS_PT_train", "REFGS_PT_run", "REFGS_PT_materials", "REFGS_PT_light", "REFGS_PT_preview"):
        # Blender calls functions appended to a panel each time it draws it.
        getattr(bpy.types, panel).append(lambda self, context: drawn.add(self.bl_idname))
    yield after(1.0)
    bpy.ops.object.select_all(action="SELECT")
    bpy.ops.object.delete()
    try:
        report["import"] = list(bpy.ops.refgs.import_run(directory=RUN))
    except RuntimeError as error:
        report["import"] = str(error)
    yield after(1.0)
    area().spaces.active.show_region_ui = True
    area().spaces.active.shading.type = "RENDERED"
    area().tag_redraw()
    yield after(3.0)
    choose_tab()
    with view():
        bpy.ops.view3d.view_all()
    yield after(15.0)
    photograph("window")
    bpy.ops.preferences.addon_disable(module=MODULE)
    report["left"] = [name for name in dir(bpy.types) if name.startswith("REFGS_")]
    report["drawn"] = sorted(drawn)


act(artist())
