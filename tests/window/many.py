"""Act as an artist in a Blender window: train a list of captures with the real trainer, and make the runs assets.

Arguments: the Python with the trainer, the list of captures, and the folder for the runs. stage.py shows the command line.
"""

import importlib.util
import sys

import bpy
from stage import MODULE, WORDS, act, after, area, choose_tab, install, jobs, photograph, report, set_python

PYTHON, CAPTURES, RESULTS = WORDS


def rows():
    """Return the table's rows as the panel has them: name, state, words."""
    return [(row.name, row.state, row.words) for row in bpy.context.window_manager.refgs_rows]


def artist():
    """Install the extension, press Train Many, watch the table, select a run that failed, and press Import as Assets.

    Each `yield` gives a function; the next step waits until this function returns true.
    """
    report["numpy"] = importlib.util.find_spec("numpy") is not None
    install()
    open_panel()
    area().spaces.active.show_region_ui = True
    yield after(1.0)
    choose_tab()
    set_python(PYTHON)
    settings = bpy.context.scene.refgs.many
    settings.captures, settings.results = CAPTURES, RESULTS
    yield lambda: all(job.ended for job in jobs())
    bpy.ops.refgs.train_many()
    yield lambda: any(words.startswith("training, ") for _, _, words in rows())
    report["running"] = rows()
    yield after(1.0)
    photograph("running")
    for count in (1, 2, 3):  # a wait each: a busy machine takes minutes for all
        yield lambda count=count: sum(state in ("done", "failed") for _, state, _ in rows()) >= count
    yield lambda: jobs()[-1].ended
    report["ended"] = jobs()[-1].state, jobs()[-1].line
    yield after(3.0)
    report["rows"] = rows()
    names = [name for name, state, _ in rows() if state == "failed"]
    bpy.context.window_manager.refgs_row = [name for name, _, _ in rows()].index(names[0])
    area().tag_redraw()
    yield after(2.0)
    photograph("failed")
    bpy.ops.refgs.import_as_assets()
    yield lambda: jobs()[-1].ended
    report["assets"] = jobs()[-1].state, jobs()[-1].line
    report["libraries"] = [library.path for library in bpy.context.preferences.filepaths.asset_libraries]
    yield after(2.0)
    photograph("assets")


def open_panel():
    """Let the panel Train Many be open when it is drawn first: a script cannot click on its title."""
    panel = sys.modules[f"{MODULE}.refgs_addon.trainer.ui.many_panel"].ManyPanel
    bpy.utils.unregister_class(panel)
    panel.bl_options = set()
    bpy.utils.register_class(panel)


act(artist())
