"""Draw the tab RefGS in the image editor's sidebar, where strokes that correct masks are painted."""

import bpy

from ... import jobs
from ...preferences import letters
from ...scene.camera_objects import STROKES
from .photo_buttons import PAINTS, ChooseBrush, SaveStrokes
from .train_panel import draw_job


class StrokesPanel(bpy.types.Panel):
    bl_idname = "REFGS_PT_strokes"
    bl_label = "Mask"
    bl_space_type = "IMAGE_EDITOR"
    bl_region_type = "UI"
    bl_category = "RefGS"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.space_data.image is not None and STROKES in context.space_data.image

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        width = letters(context)
        column = layout.column(align=True)
        for paints, icon in (("object", "MESH_CIRCLE"), ("rest", "SHADING_SOLID"), ("nothing", "X")):
            column.operator(ChooseBrush.bl_idname, text=PAINTS[paints][0], icon=icon).paints = paints
        layout.label(text="The mask leaves out what is red")
        layout.operator(SaveStrokes.bl_idname, icon="FILE_TICK")
        for job in jobs.JOBS:
            if job.kind == "masks":
                draw_job(layout.box(), context.scene, job, width)


CLASSES = (StrokesPanel,)
