"""Ask before Blender closes whether running trainings continue or stop.

Blender does not tell an add-on that it is about to close. So the question comes only with the quit key, and with an entry that this module
adds to the File menu. If Blender is closed in another way, a training continues only if the checkbox Keep Training when Blender Closes is
set for it.
"""

import sys
from pathlib import Path
from typing import ClassVar

import bpy
from bpy.props import EnumProperty

from ... import jobs
from ...ui.operators import OnJob, OnRunFolder, ReportsErrors

_keys: list[tuple[bpy.types.KeyMap, bpy.types.KeyMapItem]] = []


class KeepTraining(OnJob, bpy.types.Operator):
    bl_idname = "refgs.keep"
    bl_label = "Keep Training when Blender Closes"
    bl_description = (
        "Finish the training and its mesh even if Blender closes; the file finds the run when opened again. Otherwise "
        "the training stops, and can be resumed. A training that still waits never starts"
    )

    def work(self, context: bpy.types.Context) -> None:
        self.job.keep(not self.job.kept)


class StopRun(OnRunFolder, bpy.types.Operator):
    bl_idname = "refgs.stop_run"
    bl_label = "Stop"
    bl_description = "Stop this training, which another process runs; it can be resumed later"
    bl_options: ClassVar = {"REGISTER"}

    def work(self, context: bpy.types.Context) -> None:
        jobs.stop_run(Path(self.folder))


CHOICES = {
    "ASK": "Quit Blender after asking whether the trainings continue",
    "LEAVE": "Quit Blender. Running trainings finish, waiting ones never start",
    "STOP": "Quit Blender. Trainings stop with a checkpoint, and can be resumed",
}


class Quit(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.quit"
    bl_label = "Quit Blender"
    bl_options: ClassVar = {"INTERNAL"}

    choice: EnumProperty(
        name="Trainings",
        description="Continue or stop the trainings",
        items=[(key, key.title(), what) for key, what in CHOICES.items()],
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enable this operator only while trainings run or wait."""
        cls.poll_message_set("Nothing is being trained")
        return bool(jobs.trainings())

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return CHOICES[properties.choice]

    def invoke(self, context, event):
        if self.choice != "ASK":
            return self.execute(context)
        return context.window_manager.invoke_props_dialog(self, title=quit_question())

    def draw(self, context: bpy.types.Context) -> None:
        column = self.layout.column()
        column.template_popup_confirm(self.bl_idname, text="Leave Running", cancel_text="").choice = "LEAVE"
        column.template_popup_confirm(self.bl_idname, text="Stop Cleanly", cancel_text="").choice = "STOP"
        column.template_popup_confirm("", text="", cancel_text="Cancel")

    def work(self, context: bpy.types.Context) -> None:
        if self.choice != "ASK":
            jobs.keep_all(self.choice == "LEAVE")
            bpy.ops.wm.quit_blender("INVOKE_DEFAULT")  # asks whether to save


def quit_question() -> str:
    """Return the title of the dialog that asks before quitting."""
    number = len(jobs.trainings())
    return "A training is running" if number == 1 else f"{number} trainings are running or waiting"


def draw_quit(self, context: bpy.types.Context) -> None:
    """Draw a File menu entry that asks before quitting while a training runs or waits."""
    if jobs.trainings():
        self.layout.operator_context = "INVOKE_DEFAULT"
        self.layout.operator(Quit.bl_idname, text="Quit with Trainings Running…", icon="QUIT")


CLASSES = (KeepTraining, StopRun, Quit)


def register() -> None:
    bpy.types.TOPBAR_MT_file.append(draw_quit)
    if (keys := bpy.context.window_manager.keyconfigs.addon) is not None:  # None without a window
        keymap = keys.keymaps.new("Window")
        mac = sys.platform == "darwin"
        _keys.append((keymap, keymap.keymap_items.new(Quit.bl_idname, "Q", "PRESS", ctrl=not mac, oskey=mac)))


def unregister() -> None:
    for keymap, item in _keys:
        keymap.keymap_items.remove(item)
    _keys.clear()
    bpy.types.TOPBAR_MT_file.remove(draw_quit)
