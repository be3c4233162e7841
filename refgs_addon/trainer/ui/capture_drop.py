"""Handle a transforms.json that is dropped on the 3D view: its folder becomes the capture to train on."""

import bpy

from ...ui.drop import Drop, OnView
from ..preferences import set_up
from ..scene import training


class DropCapture(Drop, bpy.types.Operator):
    bl_idname = "refgs.drop_capture"
    bl_label = "Choose RefGS Capture"
    bl_description = "Choose the capture of this transforms.json, and check it"

    def work(self, context: bpy.types.Context) -> None:
        context.scene.refgs.capture = str(self.folder("transforms"))
        if set_up():
            training.check(context.scene)


class CaptureFile(OnView, bpy.types.FileHandler):
    bl_idname = "REFGS_FH_capture"
    bl_label = "RefGS Capture"
    bl_import_operator = DropCapture.bl_idname
    bl_file_extensions = ".json"


CLASSES = (DropCapture, CaptureFile)
