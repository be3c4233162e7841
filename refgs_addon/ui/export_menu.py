"""Define the operators that export a run, and add them to the File menu."""

from pathlib import Path
from typing import ClassVar

import bpy
from bpy.props import EnumProperty, StringProperty
from bpy_extras.io_utils import ExportHelper

from ..scene import training
from ..scene.run_parts import FOLDER, active_run
from .operators import ImportRun, OnRun, has_trainer


class _Export(OnRun, ExportHelper):
    """Export a part (`kind`, such as "mesh") of the active run to a chosen file."""

    bl_options: ClassVar = {"REGISTER"}

    filter_glob: StringProperty(options={"HIDDEN"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        folder = Path(active_run(context).get(FOLDER, ""))
        self.filter_glob = f"*{self.filename_ext}" if self.filename_ext else ""
        self.filepath = str(folder.with_name(f"{folder.name} {self.kind}{self.filename_ext}"))
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def chosen(self) -> dict[str, str]:
        """Return the artist's choices as keyword arguments of the function that writes the file."""
        return {}

    def work(self, context: bpy.types.Context) -> None:
        from ..scene import export_run

        write = {"splats": export_run.export_splats, "mesh": export_run.export_mesh, "light": export_run.export_light}[
            self.kind
        ]
        write(active_run(context), Path(bpy.path.abspath(self.filepath)), **self.chosen())
        self.report({"INFO"}, f"Wrote {self.filepath}")


class ExportSplats(_Export, bpy.types.Operator):
    bl_idname = "refgs.export_splats"
    bl_label = "RefGS Splats (.ply)"
    bl_description = "Export the splats with their edited materials, for RefGS and for viewers of Gaussian splats"

    kind, filename_ext = "splats", ".ply"


class ExportDisplaySplats(_Export, bpy.types.Operator):
    bl_idname = "refgs.export_display_splats"
    bl_label = "RefGS Display Splats (.ply)"
    bl_description = (
        "Let the trainer make splats for viewers without lights, in the colours of the edited run "
        "under the recovered light"
    )

    kind, filename_ext = "display splats", ".ply"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return has_trainer(cls) and super().poll(context)

    def work(self, context: bpy.types.Context) -> None:
        file = Path(bpy.path.abspath(self.filepath))
        training.export_display_splats(active_run(context), file)
        self.report({"INFO"}, f"Making {file.name}: the Train panel shows the progress")


class ExportMesh(_Export, bpy.types.Operator):
    bl_idname = "refgs.export_mesh"
    bl_label = "RefGS Mesh with Textures (.glb)"
    bl_description = "Export the mesh with its base colour, metallic, roughness and normal textures"

    kind, filename_ext = "mesh", ".glb"


class _ExportMeshFor(_Export):
    engine: EnumProperty(
        name="Textures for",
        description="Write textures as a game engine packs them beside the separate ones",
        items=[
            ("Any Program", "Any Program", "Base colour, metallic, roughness, normal and occlusion"),
            ("Unreal", "Unreal Engine", "Also occlusion, roughness and metallic in one, and a normal map with Y down"),
            ("Unity", "Unity", "Also metallic with smoothness in its alpha"),
        ],
    )

    def chosen(self) -> dict[str, str]:
        return {"engine": self.engine}


class ExportMeshUsd(_ExportMeshFor, bpy.types.Operator):
    bl_idname = "refgs.export_mesh_usd"
    bl_label = "RefGS Mesh with Textures (.usdc)"
    bl_description = "Export the mesh as USD, with its textures in a folder beside it, whatever is hidden or selected"

    kind, filename_ext = "mesh", ".usdc"


class ExportMeshFbx(_ExportMeshFor, bpy.types.Operator):
    bl_idname = "refgs.export_mesh_fbx"
    bl_label = "RefGS Mesh with Textures (.fbx)"
    bl_description = "Export the mesh as FBX, with its textures in a folder beside it, whatever is hidden or selected"

    kind, filename_ext = "mesh", ".fbx"


class ExportLight(_Export, bpy.types.Operator):
    bl_idname = "refgs.export_light"
    bl_label = "RefGS Recovered Light (.exr)"
    bl_description = "Export the light recovered from the photos as a panorama"

    kind, filename_ext = "light", ".exr"


class ApplyEdits(_Export, bpy.types.Operator):
    bl_idname = "refgs.apply_edits"
    bl_label = "Apply to New Run"
    bl_description = (
        "Write the run with its edits as a new run folder. The trainer, if set up, makes its mesh and textures. "
        "The imported run does not change"
    )

    kind, filename_ext = "edited", ""
    check_extension = None

    def work(self, context: bpy.types.Context) -> None:
        out = Path(bpy.path.abspath(self.filepath))
        job = training.apply_edits(context.scene, active_run(context), out)
        mesh = "" if (out / "mesh.glb").exists() else "; set up the trainer in the preferences to make its mesh"
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
