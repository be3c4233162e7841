"""Install the extensions in a Blender window, first RefGS alone and then its trainer, take screenshots and write a report.

Its argument is the run folder. stage.py shows the command line.
"""

import importlib.util
from pathlib import Path

import bpy
from stage import MODULE, OUT, TRAINER, WORDS, act, addon, after, area, choose_tab, install, photograph, report, view

(RUN,) = WORDS
PANELS = "run", "materials", "light", "preview"


def artist():
    """Install RefGS, import, edit, relight, export and render a run; add the trainer; disable both.

    Each `yield` gives a function; the next step waits until this function returns true.
    """
    report["numpy"], drawn = importlib.util.find_spec("numpy") is not None, set()

    def watch(*names):
        # Blender calls functions appended to a panel each time it draws it.
        for name in names:
            panel = getattr(bpy.types, f"REFGS_PT_{name}")
            panel.append(lambda self, context: drawn.add(self.bl_idname))

    install("refgs")
    report["enabled"] = [module in bpy.context.preferences.addons for module in (MODULE, TRAINER)]
    watch(*PANELS)
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
    photograph("alone")
    report["drawn"] = sorted(drawn)
    if report["import"] == ["FINISHED"]:
        yield from work_alone()
    drawn.clear()
    install("refgs_trainer")
    watch("train")
    yield after(5.0)
    photograph("both")
    report["drawn with the trainer"] = sorted(drawn)
    bpy.ops.preferences.addon_disable(module=MODULE)
    yield after(2.0)
    photograph("trainer alone")
    report["trainer alone"] = [name for name in dir(bpy.types) if name.startswith("REFGS_")]
    bpy.ops.preferences.addon_enable(module=MODULE)
    yield after(2.0)
    report["enabled again"] = hasattr(bpy.types, "REFGS_PT_train")
    for module in (MODULE, TRAINER):
        bpy.ops.preferences.addon_disable(module=module)
    report["left"] = [name for name in dir(bpy.types) if name.startswith("REFGS_")]


def work_alone():
    """Edit, relight, export and render the run, with RefGS alone."""
    with view():
        bpy.ops.refgs.add_edit(where="Everywhere", material="Gold")
        bpy.ops.refgs.relight(filepath=str(addon("scene.world_light").hdris()[0]))
    for name in ("splats.ply", "mesh.glb", "light.exr"):
        getattr(bpy.ops.refgs, f"export_{name[:-4]}")(filepath=str(OUT / name))
    bpy.ops.refgs.apply_edits(filepath=str(OUT / "edited"))
    report["wrote"] = sorted(path.name for path in Path(OUT, "edited").iterdir())
    bpy.ops.refgs.render_preview(filepath=str(OUT / "preview.png"), size=32, samples=1)
    job = addon("jobs").JOBS[-1]
    yield lambda: job.ended
    report["render"] = job.state, job.line


act(artist())
