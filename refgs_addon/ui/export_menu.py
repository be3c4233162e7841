"""Ways out of Blender, and the entries of the File menu."""

from pathlib import Path
from typing import ClassVar

import bpy
from bpy.props import StringProperty
from bpy_extras.io_utils import ExportHelper

from ..scene import training
from ..scene.run_parts import FOLDER, active_run
from .operators import Door, ImportRun, has_run, has_trainer


class _Export(Door, ExportHelper):
    """Writes something of the active run to a file."""

    bl_options: ClassVar = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return has_run(cls, context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        folder = Path(active_run(context).get(FOLDER, ""))
        self.filepath = str(folder.with_name(f"{folder.name} {self.kind}{self.filename_ext}"))
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def work(self, context: bpy.types.Context) -> None:
        from ..scene import export_run

        write = {"splats": export_run.export_splats, "mesh": export_run.export_mesh, "light": export_run.export_light}[
            self.kind
        ]
        write(active_run(context), Path(bpy.path.abspath(self.filepath)))
        self.report({"INFO"}, f"Wrote {self.filepath}")


class ExportSplats(_Export, bpy.types.Operator):
    bl_idname = "refgs.export_splats"
    bl_label = "RefGS Splats (.ply)"
    bl_description = "Write the splats with their edited materials, as RefGS and viewers of Gaussian splats read them"

    kind, filename_ext = "splats", ".ply"
    filter_glob: StringProperty(default="*.ply", options={"HIDDEN"})


class ExportDisplaySplats(_Export, bpy.types.Operator):
    bl_idname = "refgs.export_display_splats"
    bl_label = "RefGS Display Splats (.ply)"
    bl_description = (
        "Have the trainer write splats for viewers that know no light, in the colours that the run with its edits shows "
        "under the recovered light"
    )

    kind, filename_ext = "display splats", ".ply"
    filter_glob: StringProperty(default="*.ply", options={"HIDDEN"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return has_trainer(cls) and has_run(cls, context)

    def work(self, context: bpy.types.Context) -> None:
        file = Path(bpy.path.abspath(self.filepath))
        training.export_display_splats(active_run(context), file)
        self.report({"INFO"}, f"{file.name} is being made: the Train panel shows how far it is")


class ExportMesh(_Export, bpy.types.Operator):
    bl_idname = "refgs.export_mesh"
    bl_label = "RefGS Mesh with Textures (.glb)"
    bl_description = "Write the mesh with its base colour, metallic, roughness and normal textures"

    kind, filename_ext = "mesh", ".glb"
    filter_glob: StringProperty(default="*.glb", options={"HIDDEN"})


class ExportMeshUsd(_Export, bpy.types.Operator):
    bl_idname = "refgs.export_mesh_usd"
    bl_label = "RefGS Mesh with Textures (.usdc)"
    bl_description = "Write the mesh as USD, its textures in a folder beside it, whatever is hidden or selected"

    kind, filename_ext = "mesh", ".usdc"
    filter_glob: StringProperty(default="*.usdc", options={"HIDDEN"})


class ExportMeshFbx(_Export, bpy.types.Operator):
    bl_idname = "refgs.export_mesh_fbx"
    bl_label = "RefGS Mesh with Textures (.fbx)"
    bl_description = "Write the mesh as FBX, its textures in a folder beside it, whatever is hidden or selected"

    kind, filename_ext = "mesh", ".fbx"
    filter_glob: StringProperty(default="*.fbx", options={"HIDDEN"})


class ExportLight(_Export, bpy.types.Operator):
    bl_idname = "refgs.export_light"
    bl_label = "RefGS Recovered Light (.exr)"
    bl_description = "Write the light that was recovered from the photos, as a panorama"

    kind, filename_ext = "light", ".exr"
    filter_glob: StringProperty(default="*.exr", options={"HIDDEN"})


class ApplyEdits(_Export, bpy.types.Operator):
    bl_idname = "refgs.apply_edits"
    bl_label = "Apply to New Run"
    bl_description = (
        "Write the run with its edits as a new run folder, with a mesh and textures where the trainer is set up; "
        "the run that was imported stays as it is"
    )

    kind, filename_ext = "edited", ""
    check_extension = None

    def work(self, context: bpy.types.Context) -> None:
        out = Path(bpy.path.abspath(self.filepath))
        job = training.apply_edits(context.scene, active_run(context), out)
        mesh = "" if (out / "mesh.glb").exists() else "; set up the trainer in the preferences for a mesh of it"
        self.report({"INFO"}, f"Wrote {out}" + ("; its mesh is being made" if job else mesh))


FILES = (ExportSplats, ExportDisplaySplats, ExportMesh, ExportMeshUsd, ExportMeshFbx, ExportLight)
CLASSES = (*FILES, ApplyEdits)


def _import_menu(self, context: bpy.types.Context) -> None:
    self.layout.operator(ImportRun.bl_idname, text="RefGS Run (folder)")


def _export_menu(self, context: bpy.types.Context) -> None:
    for operator in FILES:
        self.layout.operator(operator.bl_idname)
    self.layout.operator(ApplyEdits.bl_idname, text="RefGS Run with Edits (folder)")


def register() -> None:
    bpy.types.TOPBAR_MT_file_import.append(_import_menu)
    bpy.types.TOPBAR_MT_file_export.append(_export_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_export.remove(_export_menu)
    bpy.types.TOPBAR_MT_file_import.remove(_import_menu)
