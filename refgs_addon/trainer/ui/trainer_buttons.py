"""Define the operators of the preferences: query, install and remove the trainer."""

from typing import ClassVar

import bpy

from ...ui.operators import ReportsErrors
from .. import preferences


class QueryTrainer(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.ask_trainer"
    bl_label = "Query the Trainer"
    bl_description = "Ask the chosen Python for the trainer's release and its device"
    bl_options: ClassVar = {"REGISTER"}

    def work(self, context: bpy.types.Context) -> None:
        preferences.query_trainer()


class InstallTrainer(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.install_trainer"
    bl_label = "Install the Trainer"
    bl_description = (
        "Download the trainer's packages and install them in the extension's own folder, in the background. "
        "Nothing else on this machine changes"
    )
    bl_options: ClassVar = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        reason = preferences.installation_problem()
        cls.poll_message_set(reason)
        return not reason

    def work(self, context: bpy.types.Context) -> None:
        preferences.install()


class StopInstalling(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.stop_installing"
    bl_label = "Stop Installing"
    bl_description = "Stop the installation. Finished downloads are kept, and it can be resumed"
    bl_options: ClassVar = {"REGISTER"}

    def work(self, context: bpy.types.Context) -> None:
        preferences.stop()


class RemoveTrainer(ReportsErrors, bpy.types.Operator):
    bl_idname = "refgs.remove_trainer"
    bl_label = "Remove the Trainer"
    bl_description = "Delete the installed trainer and its packages"
    bl_options: ClassVar = {"REGISTER"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_confirm(
            self, event, title="Remove the trainer?", message=f"Deletes {preferences.home()}", confirm_text="Remove"
        )

    def work(self, context: bpy.types.Context) -> None:
        preferences.remove()


CLASSES = (QueryTrainer, InstallTrainer, StopInstalling, RemoveTrainer)
