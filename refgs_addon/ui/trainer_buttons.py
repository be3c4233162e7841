"""The preferences' buttons."""

from typing import ClassVar

import bpy

from .. import preferences
from .operators import Door


class AskTrainer(Door, bpy.types.Operator):
    bl_idname = "refgs.ask_trainer"
    bl_label = "Ask the Trainer"
    bl_description = "Ask the Python that is used for RefGS's trainer which one it is and what it trains on"
    bl_options: ClassVar = {"REGISTER"}

    def work(self, context: bpy.types.Context) -> None:
        preferences.ask()


class InstallTrainer(Door, bpy.types.Operator):
    bl_idname = "refgs.install_trainer"
    bl_label = "Install the Trainer"
    bl_description = (
        "Fetch what the trainer needs from the network and install it in the add-on's own folder, in the background. "
        "Nothing else on this machine is changed"
    )
    bl_options: ClassVar = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        reason = preferences.why_no_installation()
        cls.poll_message_set(reason)
        return not reason

    def work(self, context: bpy.types.Context) -> None:
        preferences.install()


class StopInstalling(Door, bpy.types.Operator):
    bl_idname = "refgs.stop_installing"
    bl_label = "Stop Installing"
    bl_description = "Stop here; what has been fetched is kept, and the installation can be gone on with"
    bl_options: ClassVar = {"REGISTER"}

    def work(self, context: bpy.types.Context) -> None:
        preferences.stop()


class RemoveTrainer(Door, bpy.types.Operator):
    bl_idname = "refgs.remove_trainer"
    bl_label = "Remove the Trainer"
    bl_description = "Delete the trainer that was installed from here, with all that it came with"
    bl_options: ClassVar = {"REGISTER"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_confirm(
            self, event, title="Remove the trainer?", message=f"Deletes {preferences.home()}", confirm_text="Remove"
        )

    def work(self, context: bpy.types.Context) -> None:
        preferences.remove()


CLASSES = (AskTrainer, InstallTrainer, StopInstalling, RemoveTrainer)
