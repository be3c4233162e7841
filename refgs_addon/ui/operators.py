"""Operators: thin doors from a button to a function of `scene`."""

import math
from pathlib import Path
from typing import ClassVar

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty
from bpy_extras.io_utils import ExportHelper, ImportHelper

from ..errors import InputError
from ..scene.parts import show
from ..scene.preview import render_preview
from ..scene.relight import relight


class Door:
    """Runs `work`; an InputError becomes one line of report."""

    bl_options: ClassVar = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            self.work(context)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


def import_run_folder(operator: bpy.types.Operator, context: bpy.types.Context, folder: Path) -> None:
    """Import a run, and report what came of it."""
    try:
        from ..scene.run import import_run
    except ModuleNotFoundError as error:  # Debian's Blender may come without numpy; the rest works without
        raise InputError(f"Blender's Python lacks {error.name}: install it (on Debian, python3-numpy)") from None
    run = import_run(folder, context.scene)
    operator.report({"INFO"}, f"Imported {run.collection.name}: {len(run.splats.data.points):,} splats")
    if run.light_of:
        said = f"The light turned with the camera: the world is as it was for {run.light_of}, and for no other photo"
        operator.report({"WARNING"}, said)


class ImportRun(Door, bpy.types.Operator):
    bl_idname = "refgs.import_run"
    bl_label = "Import RefGS Run"
    bl_description = "Import a run folder: splats, mesh, recovered light and cameras"

    directory: StringProperty(name="Run Folder", subtype="DIR_PATH")
    filter_folder: BoolProperty(default=True, options={"HIDDEN"})

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def work(self, context: bpy.types.Context) -> None:
        import_run_folder(self, context, Path(bpy.path.abspath(self.directory)))


class ShowPart(Door, bpy.types.Operator):
    bl_idname = "refgs.show"
    bl_label = "Show"
    bl_description = "Show the run's splats or its mesh, in the viewport and in renders"

    collection: StringProperty(name="Run", description="The run's collection")
    part: EnumProperty(name="Part", items=[("splats", "Splats", ""), ("mesh", "Mesh", "")])

    def work(self, context: bpy.types.Context) -> None:
        show(bpy.data.collections[self.collection], self.part)


class Relight(Door, ImportHelper, bpy.types.Operator):
    bl_idname = "refgs.relight"
    bl_label = "Relight with HDRI"
    bl_description = "Light the scene with a panorama; the recovered light is kept"

    filter_glob: StringProperty(default="*.exr;*.hdr", options={"HIDDEN"})
    rotation: FloatProperty(
        name="Rotation", description="Turn the light counter-clockwise, seen from above", subtype="ANGLE",
        soft_min=-math.pi, soft_max=math.pi,
    )  # fmt: skip
    strength: FloatProperty(name="Strength", default=1.0, min=0.0, soft_max=10.0)

    def work(self, context: bpy.types.Context) -> None:
        relight(context.scene, Path(bpy.path.abspath(self.filepath)), self.rotation, self.strength)


class RecoveredLight(Door, bpy.types.Operator):
    bl_idname = "refgs.recovered_light"
    bl_label = "Recovered Light"
    bl_description = "Light the scene with the panorama that was recovered from the photos"

    def work(self, context: bpy.types.Context) -> None:
        relight(context.scene, None)


class RenderPreview(Door, ExportHelper, bpy.types.Operator):
    bl_idname = "refgs.render_preview"
    bl_label = "Render Preview"
    bl_description = "Render the scene camera's view in Eevee to a PNG with a transparent background"
    bl_options: ClassVar = {"REGISTER"}

    filename_ext = ".png"
    filter_glob: StringProperty(default="*.png", options={"HIDDEN"})
    size: IntProperty(name="Size", description="Longer side in pixels; 0 keeps the photo's", default=0, min=0, max=8192)
    samples: IntProperty(name="Samples", default=64, min=1, max=4096)

    def work(self, context: bpy.types.Context) -> None:
        render_preview(
            context.scene, Path(bpy.path.abspath(self.filepath)), size=self.size or None, samples=self.samples
        )
        self.report({"INFO"}, f"Wrote {self.filepath}")


CLASSES = (ImportRun, ShowPart, Relight, RecoveredLight, RenderPreview)
