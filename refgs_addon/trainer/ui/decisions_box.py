"""Draw the decisions of a training in the Train panel, each as a choice with pictures of both answers.

A decision says whether the training kept an optional part of the method, such as specular reflection.
"""

from pathlib import Path

import bpy
from bpy.props import StringProperty

from ...preferences import wrapped_text
from ...ui.icons import thumbnail
from ...ui.operators import OnRunFolder
from ..scene import training
from ..scene.decisions import Decision, confirm, open_decisions
from .on_capture import has_trainer

NAMES = {  # the question, and its two answers
    "specular": ("Gloss", "Glossy", "Matte"),
    "reflections": ("Reflections", "Object Too", "Light Only"),
    "light": ("Light", "Sharp", "Soft"),
}
PICTURE = 0.11  # lines of height for each letter of width: pictures fill a third of the sidebar


class _OnDecision(OnRunFolder):
    """Store the decision that an operator works on, about the optional part `need`."""

    need: StringProperty(name="Need")


class KeepDecision(_OnDecision, bpy.types.Operator):
    bl_idname = "refgs.keep_decision"
    bl_label = "Keep"
    bl_description = "Keep what the training decided, and remove the question from the panel"

    def work(self, context: bpy.types.Context) -> None:
        confirm(context.scene, Path(self.folder), self.need)


class TrainOtherWay(_OnDecision, bpy.types.Operator):
    bl_idname = "refgs.train_other_way"
    bl_label = "Train Again"
    bl_description = (
        "Train again into a new folder with the other answer, and the settings of this panel. This run stays"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return has_trainer(cls)

    def work(self, context: bpy.types.Context) -> None:
        training.train_other_way(context.scene, Path(self.folder), self.need)


def draw_decisions(box: bpy.types.UILayout, scene: bpy.types.Scene, folder: Path, width: int) -> None:
    """Draw those decisions of a training that the artist has not confirmed yet, such as whether the object is glossy or matte.

    `folder` is the run folder, and `width` is how many letters fit into a line.
    """
    for decision in open_decisions(scene, folder):
        _draw(box.box(), folder, decision, width)


def _draw(box: bpy.types.UILayout, folder: Path, decision: Decision, width: int) -> None:
    question, *answers = NAMES.get(decision.need, (decision.what, "With", "Without"))
    names = dict(zip(("on", "off"), answers, strict=True))
    box.label(text=f"{question}: {names[decision.answer]}", icon="QUESTION")
    wrapped_text(box, decision.why[0].upper() + decision.why[1:], width)
    row = box.row()
    for kind, name in (*names.items(), ("photo", "Photo")):
        column = row.column(align=True)
        written = decision.pictures[kind].stat().st_mtime_ns if decision.pictures[kind].is_file() else 0
        icon = thumbnail(decision.pictures[kind], written) if written else 0
        column.template_icon(icon_value=icon, scale=max(3.0, PICTURE * width))
        column.label(text=name)
        column.label(text=f"{decision.psnr[kind]:.2f} dB" if kind in decision.psnr else decision.view)
    column = box.column(align=True)
    for operator, text, icon in (
        (KeepDecision, f"Keep {names[decision.answer]}", "CHECKMARK"),
        (TrainOtherWay, f"Train {names[decision.other]}", "PLAY"),
    ):
        button = column.operator(operator.bl_idname, text=text, icon=icon)
        button.folder, button.need = str(folder), decision.need


CLASSES = (KeepDecision, TrainOtherWay)
