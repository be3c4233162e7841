"""Define the trainer's preferences, and the panel that says why the trainer is not there."""

import importlib
import textwrap

import bpy
from bpy.props import StringProperty

from . import joining


def _chosen(self, context: bpy.types.Context) -> None:
    if module := joining.trainer():
        importlib.import_module(f"{module.__name__}.preferences").query_trainer()


class Preferences(bpy.types.AddonPreferences):
    bl_idname = __package__

    python: StringProperty(
        name="Python",
        description="Python of an environment that has RefGS's trainer, such as refgs/.venv/bin/python. "
        "If left empty, the trainer installed above is used",
        subtype="FILE_PATH",
        update=_chosen,
    )
    mask_model: StringProperty(
        name="Mask Model",
        description="ONNX file of a model that segments salient objects, such as BiRefNet. "
        "If left empty, Make Masks uses the model that comes with RefGS",
        subtype="FILE_PATH",
    )

    def draw(self, context: bpy.types.Context) -> None:
        if module := joining.trainer():
            importlib.import_module(f"{module.__name__}.preferences").draw(self.layout, context)
        else:
            _draw_problem(self.layout, 80)


class ProblemPanel(bpy.types.Panel):
    bl_idname = "REFGS_PT_no_trainer"
    bl_label = "Train"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "RefGS"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return joining.trainer() is None

    def draw(self, context: bpy.types.Context) -> None:
        _draw_problem(self.layout, 30)


def _draw_problem(layout: bpy.types.UILayout, width: int) -> None:
    """Draw why the trainer is not a part of RefGS, on lines of at most `width` letters."""
    column = layout.column(align=True)
    for number, line in enumerate(textwrap.wrap(joining.problem(), width)):
        column.label(text=line, icon="BLANK1" if number else "ERROR")
