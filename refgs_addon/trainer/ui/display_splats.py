"""Define the operators that export display splats (splats with fixed colours), and add them to the File menu."""

from pathlib import Path

import bpy

from ...scene.run_parts import active_run
from ...ui.export_menu import Export
from ..scene import training
from .on_capture import has_trainer


class _ExportDisplaySplats(Export):
    bl_description = (
        "Let the trainer make splats for viewers without lights, in the colours of the edited run "
        "under the recovered light"
    )

    kind = "display splats"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return has_trainer(cls) and super().poll(context)

    def work(self, context: bpy.types.Context) -> None:
        file = Path(bpy.path.abspath(self.filepath))
        training.export_display_splats(active_run(context), file)
        self.report({"INFO"}, f"Making {file.name}: the Train panel shows the progress")


class ExportDisplaySplats(_ExportDisplaySplats, bpy.types.Operator):
    bl_idname = "refgs.export_display_splats"
    bl_label = "RefGS Display Splats (.ply)"

    filename_ext = ".ply"


class ExportDisplaySplatsGltf(_ExportDisplaySplats, bpy.types.Operator):
    bl_idname = "refgs.export_display_splats_gltf"
    bl_label = "RefGS Display Splats (.glb)"

    filename_ext = ".glb"


class ExportDisplaySplatsSpz(_ExportDisplaySplats, bpy.types.Operator):
    bl_idname = "refgs.export_display_splats_spz"
    bl_label = "RefGS Display Splats (.spz)"

    filename_ext = ".spz"


class ExportDisplaySplatsUsd(_ExportDisplaySplats, bpy.types.Operator):
    bl_idname = "refgs.export_display_splats_usd"
    bl_label = "RefGS Display Splats (.usdc)"

    filename_ext = ".usdc"


CLASSES = (ExportDisplaySplats, ExportDisplaySplatsGltf, ExportDisplaySplatsSpz, ExportDisplaySplatsUsd)


def _export_menu(self, context: bpy.types.Context) -> None:
    for operator in CLASSES:
        self.layout.operator(operator.bl_idname)


def register() -> None:
    bpy.types.TOPBAR_MT_file_export.append(_export_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_export.remove(_export_menu)
