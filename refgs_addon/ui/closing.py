"""Closing Blender while it trains. Blender asks no add-on whether it may close, so only the key that quits and an entry of the File menu
ask first; for all other ways each training says beforehand whether it goes on."""

import sys
from pathlib import Path
from typing import ClassVar

import bpy
from bpy.props import EnumProperty, IntProperty, StringProperty

from .. import jobs
from .operators import Door

_keys: list[tuple[bpy.types.KeyMap, bpy.types.KeyMapItem]] = []


class Keep(Door, bpy.types.Operator):
    bl_idname = "refgs.keep"
    bl_label = "Keep Training when Blender Closes"
    bl_description = (
        "Go on to the end, mesh included, when Blender closes; opened again, the file finds the run. Otherwise the "
        "training stops then, and can be gone on with. One that still waits for another by then does not begin"
    )
    bl_options: ClassVar = {"REGISTER"}

    number: IntProperty(name="Number", description="Of the job in the list")

    def work(self, context: bpy.types.Context) -> None:
        job = jobs.JOBS[self.number]
        job.keep(not job.kept)


class StopRun(Door, bpy.types.Operator):
    bl_idname = "refgs.stop_run"
    bl_label = "Stop"
    bl_description = "Have this training stop, which goes on without this Blender; it can be gone on with later"
    bl_options: ClassVar = {"REGISTER"}

    folder: StringProperty(name="Run Folder")

    def work(self, context: bpy.types.Context) -> None:
        jobs.stop_run(Path(self.folder))


CHOICES = {
    "ASK": "Quit Blender, after asking whether trainings go on without it",
    "LEAVE": "Quit Blender; what is being trained goes on to its end. What waits for another training does not begin",
    "STOP": "Quit Blender; trainings stop with all that they have learned, and can be gone on with",
}


class Quit(Door, bpy.types.Operator):
    bl_idname = "refgs.quit"
    bl_label = "Quit Blender"
    bl_options: ClassVar = {"INTERNAL"}

    choice: EnumProperty(
        name="Trainings",
        description="What becomes of them",
        items=[(key, key.title(), what) for key, what in CHOICES.items()],
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Where nothing trains, the key is Blender's own."""
        cls.poll_message_set("Nothing is being trained")
        return bool(jobs.trainings())

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        return CHOICES[properties.choice]

    def invoke(self, context, event):
        if self.choice != "ASK":
            return self.execute(context)
        return context.window_manager.invoke_props_dialog(self, title=question())

    def draw(self, context: bpy.types.Context) -> None:
        column = self.layout.column()
        column.template_popup_confirm(self.bl_idname, text="Leave Running", cancel_text="").choice = "LEAVE"
        column.template_popup_confirm(self.bl_idname, text="Stop Cleanly", cancel_text="").choice = "STOP"
        column.template_popup_confirm("", text="", cancel_text="Cancel")

    def work(self, context: bpy.types.Context) -> None:
        if self.choice != "ASK":
            jobs.keep_all(self.choice == "LEAVE")
            bpy.ops.wm.quit_blender("INVOKE_DEFAULT")  # which asks whether to save


def question() -> str:
    """The title of what is asked."""
    number = len(jobs.trainings())
    return "A training is running" if number == 1 else f"{number} trainings are running or waiting"


def draw_quit(self, context: bpy.types.Context) -> None:
    """An entry below Blender's own Quit, while there is something to ask."""
    if jobs.trainings():
        self.layout.operator_context = "INVOKE_DEFAULT"
        self.layout.operator(Quit.bl_idname, text="Quit with Trainings Running…", icon="QUIT")


CLASSES = (Keep, StopRun, Quit)


def register() -> None:
    bpy.types.TOPBAR_MT_file.append(draw_quit)
    if (keys := bpy.context.window_manager.keyconfigs.addon) is not None:  # there is none without a window
        keymap = keys.keymaps.new("Window")
        mac = sys.platform == "darwin"
        _keys.append((keymap, keymap.keymap_items.new(Quit.bl_idname, "Q", "PRESS", ctrl=not mac, oskey=mac)))


def unregister() -> None:
    for keymap, item in _keys:
        keymap.keymap_items.remove(item)
    _keys.clear()
    bpy.types.TOPBAR_MT_file.remove(draw_quit)
