"""Define what the trainer's operators have in common."""

import bpy

from ...ui.operators import ReportsErrors
from ..preferences import set_up


class OnCapture(ReportsErrors):
    """Base class of operators on the scene's capture, the folder with the photos.

    Their buttons are disabled while no folder is chosen or the trainer is not installed. The tooltip then says what to do.
    """

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not has_trainer(cls):
            return False
        cls.poll_message_set("Choose the capture's folder first")
        return bool(context.scene.refgs.capture)


def has_trainer(operator: type[bpy.types.Operator]) -> bool:
    """Check whether a trainer is set up, and explain in the tooltip if not."""
    operator.poll_message_set("Set up the trainer in the preferences of RefGS Trainer first")
    return set_up()
