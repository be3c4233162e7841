"""Define the operators that export a run, and add them to the File menu."""

from pathlib import Path
from typing import ClassVar

import bpy
from bpy.props import EnumProperty, StringProperty
from bpy_extras.io_utils import ExportHelper

from ..compat import NO_FBX, NO_USD, has_operator
from ..scene.apply_edits import apply_edits
from ..scene.deleted_splats import count_deleted
from ..scene.edit import splats_of
from ..scene.run_parts import EXAMPLE, FOLDER, active_run, folder_of
from .operators import ImportRun, ImportSplats, OnRun


class Export(OnRun, ExportHelper):
    """Export a part (`kind`, such as "mesh") of the active run to a chosen file.

    The button is disabled while there is a `problem`, and its tooltip says which.
    """

    bl_options: ClassVar = {"REGISTER"}

    filter_glob: StringProperty(options={"HIDDEN"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not super().poll(context):
            return False
        folder = folder_of(active_run(context))
        if folder is None and FOLDER not in active_run(context):
            problem = "Another program's splats are no run. The command refgs export --splats makes one of them"
        elif folder is None:
            problem = "The run's folder was moved or deleted: press Find Run Folder in the panel Run"
        else:
            problem = cls.problem(active_run(context), folder)
        cls.poll_message_set(problem[:1].upper() + problem[1:])
        return not problem

    @classmethod
    def problem(cls, run: bpy.types.Collection, folder: Path) -> str:
        """Say what is missing for the export of a run in its folder, or return ""."""
        return ""

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        folder = Path(active_run(context).get(FOLDER, ""))
        self.filter_glob = f"*{self.filename_ext}" if self.filename_ext else ""
        beside = folder.parent
        if folder == EXAMPLE:  # updates of the add-on delete what was written there
            beside = Path(bpy.data.filepath).parent if bpy.data.filepath else Path.home()
        self.filepath = str(beside / f"{folder.name} {self.kind}{self.filename_ext}")
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


class ExportSplats(Export, bpy.types.Operator):
    bl_idname = "refgs.export_splats"
    bl_label = "RefGS Splats (.ply)"
    bl_description = "Export the splats with their edited materials, for RefGS and for viewers of Gaussian splats"

    kind, filename_ext = "splats", ".ply"


class _ExportMesh(Export):
    kind = "mesh"

    @classmethod
    def problem(cls, run: bpy.types.Collection, folder: Path) -> str:
        if not (folder / "mesh.glb").is_file():
            return "This run has no mesh. The trainer makes one: set it up, and press Apply to New Run"
        return ""

    def work(self, context: bpy.types.Context) -> None:
        super().work(context)
        warn_of_deleted(self, active_run(context))


def warn_of_deleted(operator: bpy.types.Operator, collection: bpy.types.Collection) -> None:
    """Tell the artist that a mesh was written that still contains deleted splats, if any were deleted."""
    if count_deleted(splats_of(collection)):
        text = "The mesh keeps what was fused into it of deleted splats. With the trainer, Apply to New Run makes one without"
        operator.report({"WARNING"}, text)


class ExportMesh(_ExportMesh, bpy.types.Operator):
    bl_idname = "refgs.export_mesh"
    bl_label = "RefGS Mesh with Textures (.glb)"
    bl_description = "Export the mesh with its edited base colour, metallic and roughness, and its normal texture"

    filename_ext = ".glb"


class _ExportMeshFor(_ExportMesh):
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
    bl_description = (
        "Export the mesh as USD, with its edited textures in a folder beside it, whatever is hidden or selected"
    )

    filename_ext = ".usdc"

    @classmethod
    def problem(cls, run: bpy.types.Collection, folder: Path) -> str:
        return NO_USD if not has_operator(bpy.ops.wm.usd_export) else super().problem(run, folder)


class ExportMeshFbx(_ExportMeshFor, bpy.types.Operator):
    bl_idname = "refgs.export_mesh_fbx"
    bl_label = "RefGS Mesh with Textures (.fbx)"
    bl_description = (
        "Export the mesh as FBX, with its edited textures in a folder beside it, whatever is hidden or selected"
    )

    filename_ext = ".fbx"

    @classmethod
    def problem(cls, run: bpy.types.Collection, folder: Path) -> str:
        return NO_FBX if not has_operator(bpy.ops.export_scene.fbx) else super().problem(run, folder)


class ExportLight(Export, bpy.types.Operator):
    bl_idname = "refgs.export_light"
    bl_label = "RefGS Recovered Light (.exr)"
    bl_description = "Export the light recovered from the photos as a panorama"

    kind, filename_ext = "light", ".exr"

    @classmethod
    def problem(cls, run: bpy.types.Collection, folder: Path) -> str:
        return "" if (folder / "environment.exr").is_file() else "This run has no recovered light"


class ApplyEdits(Export, bpy.types.Operator):
    bl_idname = "refgs.apply_edits"
    bl_label = "Apply to New Run"
    bl_description = (
        "Write the run with its edits as a new run folder. The trainer, if set up, makes its mesh and textures; "
        "otherwise the edits are baked into the textures. The imported run does not change"
    )

    kind, filename_ext = "edited", ""
    check_extension = None

    def work(self, context: bpy.types.Context) -> None:
        out = Path(bpy.path.abspath(self.filepath))
        job, made = apply_edits(context.scene, active_run(context), out), (out / "mesh.glb").exists()
        mesh = "" if made else "; set up the trainer in the preferences to make its mesh"
        self.report({"INFO"}, f"Wrote {out}" + ("; its mesh is being made" if job else mesh))
        if made:
            warn_of_deleted(self, active_run(context))


FILES = (ExportSplats, ExportMesh, ExportMeshUsd, ExportMeshFbx, ExportLight)
CLASSES = (*FILES, ApplyEdits)


def _import_menu(self, context: bpy.types.Context) -> None:
    self.layout.operator(ImportRun.bl_idname, text="RefGS Run (folder)")
    self.layout.operator(ImportSplats.bl_idname, text="Splats for RefGS (.ply, .spz)")


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
