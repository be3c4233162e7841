"""Test the menus: F3 finds what a menu of the 3D view has."""

from types import SimpleNamespace

import bpy

from refgs_addon import ui
from refgs_addon.scene.import_run import import_run
from refgs_addon.trainer import ui as trainer_ui
from refgs_addon.ui import menus

# Buttons of one row of a list: a job, a run, a decision, an edit, a brush. F3 has no row to give them.
OF_A_ROW = {
    "choose_brush", "choose_run", "find_run", "forget", "import_trained", "keep", "keep_decision", "keep_material",
    "paint_edit", "put_away", "remove_edit", "resume", "set_detail", "set_material", "show_cameras", "stop_run", "tell",
    "train_other_way", "watch",
}  # fmt: skip
ELSEWHERE = {"quit", "drop_run", "drop_capture"}  # the File menu has the first
PREFERENCES = {"ask_trainer", "install_trainer", "stop_installing", "remove_trainer"}


def drawn(menu):
    """Draw a menu and those in it. Returns the names of its operators with the properties that the menu gives them."""
    found = []

    def operator(name, **_):
        found.append((name.removeprefix("refgs."), SimpleNamespace()))
        return found[-1][1]

    def inner(name):
        found.extend(drawn(getattr(bpy.types, name)))

    menu.draw(SimpleNamespace(layout=SimpleNamespace(operator=operator, menu=inner, operator_context="")), bpy.context)
    return found


def test_the_menus_have_every_button(addon, run_folder):
    import_run(run_folder, addon)
    kinds = [kind for kind in (*ui.CLASSES, *trainer_ui.CLASSES) if issubclass(kind, bpy.types.Operator)]
    names = {kind.bl_idname.removeprefix("refgs.") for kind in kinds}
    exported = {name for name in names if name.startswith("export_")}  # File > Export has them
    assert {name for name, _ in drawn(menus.Menu)} == names - exported - OF_A_ROW - ELSEWHERE - PREFERENCES


def test_the_entries_work(addon, run_folder):
    bpy.ops.refgs.import_run(directory=str(run_folder))
    for name, properties in drawn(menus.RunMenu):
        if name in ("show", "crop", "delete_splats", "restore_splats"):
            assert getattr(bpy.ops.refgs, name)(**vars(properties)) == {"FINISHED"}
