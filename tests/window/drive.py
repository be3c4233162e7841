"""Install the extension in a Blender window, open its tab, take a screenshot and write a report.

blender --python drive.py -- EXTENSION.zip RUN_FOLDER OUT
"""

import importlib.util
import json
import shutil
import subprocess
import sys
import traceback
from pathlib import Path

import bpy

ARCHIVE, RUN, OUT = map(Path, sys.argv[sys.argv.index("--") + 1 :])
MODULE = "bl_ext.user_default.refgs"
bpy.context.preferences.view.show_splash = False
report = {"version": bpy.app.version_string, "numpy": importlib.util.find_spec("numpy") is not None, "drawn": []}


def install() -> float:
    bpy.ops.extensions.package_install_files(filepath=str(ARCHIVE), repo="user_default", enable_on_install=True)
    report["enabled"] = MODULE in bpy.context.preferences.addons
    for panel in ("REFGS_PT_train", "REFGS_PT_run", "REFGS_PT_materials", "REFGS_PT_light", "REFGS_PT_preview"):
        # Blender calls functions appended to a panel each time it draws it.
        getattr(bpy.types, panel).append(lambda self, context: report["drawn"].append(self.bl_idname))
    return 1.0


def import_run() -> float:
    bpy.ops.object.select_all(action="SELECT")
    bpy.ops.object.delete()
    try:
        report["import"] = list(bpy.ops.refgs.import_run(directory=str(RUN)))
    except RuntimeError as error:
        report["import"] = str(error)
    return 1.0


def open_tab() -> float:
    area = next(area for area in bpy.context.window.screen.areas if area.type == "VIEW_3D")
    area.spaces.active.show_region_ui = True
    area.spaces.active.shading.type = "RENDERED"
    area.tag_redraw()
    return 3.0


def choose_tab() -> float:
    area = next(area for area in bpy.context.window.screen.areas if area.type == "VIEW_3D")
    region = next(region for region in area.regions if region.type == "UI")
    region.active_panel_category = "RefGS"
    window = next(region for region in area.regions if region.type == "WINDOW")
    with bpy.context.temp_override(area=area, region=window):
        bpy.ops.view3d.view_all()
    area.tag_redraw()
    return 15.0


def photograph() -> float:
    # Blender's own screenshot reads a front buffer, which is black on a virtual screen; ImageMagick reads the screen.
    if shutil.which("import"):
        subprocess.run(["import", "-window", "root", str(OUT / "window.png")], check=True)
    else:
        bpy.ops.screen.screenshot(filepath=str(OUT / "window.png"))
    bpy.ops.preferences.addon_disable(module=MODULE)
    report["left"] = [name for name in dir(bpy.types) if name.startswith("REFGS_")]
    return 0.5


steps = iter((install, import_run, open_tab, choose_tab, photograph))


def next_step() -> float | None:
    try:
        step = next(steps, None)
        if step is not None:
            with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
                return step()
    except Exception:
        report["error"] = traceback.format_exc()
    report["drawn"] = sorted(set(report["drawn"]))
    (OUT / "report.json").write_text(json.dumps(report))
    bpy.ops.wm.quit_blender()
    return None


bpy.app.timers.register(next_step, first_interval=3.0)
