"""Draw the Run and Preview panels. Define the tab RefGS in the 3D view's sidebar, where all panels are."""

from pathlib import Path

import bpy

from .. import compat, hooks, jobs
from ..nodes.splats_tree import NAME as MODIFIER
from ..preferences import letters, wrapped_text
from ..scene.camera_objects import photo_shown
from ..scene.deleted_splats import points_of
from ..scene.detail import LEVELS, detail
from ..scene.run_parts import FOLDER, THEIRS, cameras, folder_of, parts, root, shown
from . import operators
from .export_menu import ApplyEdits
from .icons import thumbnail


class Tab:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "RefGS"


class RunPanel(Tab, bpy.types.Panel):
    bl_idname = "REFGS_PT_run"
    bl_label = "Run"
    bl_order = 1

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.operator(operators.ImportRun.bl_idname, icon="IMPORT")
        runs = {collection: parts(collection) for collection in context.scene.collection.children}
        if not any(runs.values()):
            layout.operator(operators.ImportExample.bl_idname, icon="MESH_MONKEY")
        for collection, found in runs.items():
            if found:
                self._run(layout.box(), collection, found)
        if not hooks.has_trainer():
            row = layout.row()
            row.label(text="The trainer is another extension")
            row.operator(operators.OpenManual.bl_idname, text="", icon="HELP", emboss=False)

    def _run(self, layout: bpy.types.UILayout, collection: bpy.types.Collection, found: dict) -> None:
        row = layout.row()
        row.label(text=collection.name, icon="POINTCLOUD_DATA")
        if FOLDER in collection:
            lost = folder_of(collection) is None
            if lost:
                layout.label(text="Its folder was moved or deleted", icon="ERROR")
            where, text = (layout, None) if lost else (row, "")
            button = where.operator(operators.FindRun.bl_idname, text=text, icon="FILE_FOLDER", emboss=lost)
            button.folder = bpy.path.abspath(collection[FOLDER])
        if THEIRS in collection:
            layout.label(text="Normals are guessed: shortest axes", icon="INFO")
        row = layout.row(align=True)
        for part in found:
            button = row.operator(operators.ShowPart.bl_idname, text=part.title(), depress=part == shown(collection))
            button.collection, button.part = collection.name, part
        if cameras(collection):
            row.prop(cameras(collection), "hide_viewport", text="Cameras", toggle=1, invert_checkbox=True)
        row = layout.row(align=True)
        row.label(text="Detail")
        now = detail(collection)
        for level in LEVELS:
            button = row.operator(operators.SetDetail.bl_idname, text=f"{level:.0%}", depress=abs(now - level) < 1e-3)
            button.collection, button.level = collection.name, level
        if root(collection):
            layout.prop(root(collection), "refgs_longest_side")
        for splats in found.get("splats", []):
            if not splats.hide_viewport and MODIFIER in splats.modifiers:
                self._splats(layout, splats)

    def _splats(self, layout: bpy.types.UILayout, splats: bpy.types.Object) -> None:
        column = layout.column()
        column.use_property_split, column.use_property_decorate = True, False
        modifier = splats.modifiers[MODIFIER]
        for name in ("Display", "Size", "Opacity Cut"):
            owner, path = compat.modifier_input(modifier, name)
            column.prop(owner, path, text=name)
        cropped = bool(compat.get_modifier_input(modifier, "Crop"))
        button = column.operator(operators.Crop.bl_idname, icon="CUBE", depress=cropped)
        button.splats, button.on = splats.name, not cropped
        points, count = points_of(splats), len(splats.data.points)
        row = layout.row(align=True)
        row.operator(operators.DeleteSplats.bl_idname, icon="TRASH").splats = splats.name
        if points is None:
            layout.label(text=f"{count:,} splats")
            return
        row.operator(operators.RestoreSplats.bl_idname, text="", icon="LOOP_BACK").splats = splats.name
        if points.mode == "EDIT":
            layout.label(text="Select points with any tool;")
            layout.label(text="X deletes them, Tab ends it")
        else:
            layout.label(text=f"{len(points.data.vertices):,} of {count:,} splats")
            layout.operator(ApplyEdits.bl_idname, icon="CHECKMARK")


class PreviewPanel(Tab, bpy.types.Panel):
    bl_idname = "REFGS_PT_preview"
    bl_label = "Preview"
    bl_order = 4

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        row = layout.row(align=True)
        row.prop(context.scene, "camera", text="Camera")
        row.operator(operators.NextCamera.bl_idname, text="", icon="TRIA_LEFT").steps = -1
        row.operator(operators.NextCamera.bl_idname, text="", icon="TRIA_RIGHT").steps = 1
        camera = context.scene.camera
        shown = photo_shown(camera) > 0
        row = layout.row(align=True)
        row.operator(operators.Photo.bl_idname, icon="IMAGE_REFERENCE", depress=shown)
        if shown:
            row.prop(camera.data.background_images[0], "alpha", text="")
        layout.operator(operators.Turntable.bl_idname, icon="FILE_REFRESH")
        layout.operator(operators.RenderPreview.bl_idname, icon="RENDER_STILL")
        layout.operator(operators.ContactSheet.bl_idname, icon="IMGDISPLAY")
        layout.operator(operators.MarkAsset.bl_idname, icon="ASSET_MANAGER")
        for job in jobs.JOBS:
            if job.kind == "render":
                self._render(layout.box(), job, letters(context))

    def _render(self, box: bpy.types.UILayout, job: jobs.Job, width: int) -> None:
        row = box.row()
        row.label(text=job.name, icon={"done": "CHECKMARK", "failed": "ERROR"}.get(job.state, "SORTTIME"))
        row.operator(operators.Dismiss.bl_idname, text="", icon="X", emboss=False).serial = job.serial
        if job.state == "done":
            png = job.results["render"]["png"]
            box.template_icon(icon_value=thumbnail(Path(png)), scale=10)
            box.operator("wm.path_open", text="Open", icon="IMAGE_DATA").filepath = png
        elif job.state == "failed":
            wrapped_text(box, job.line[0].upper() + job.line[1:], width)
            box.operator("wm.path_open", text="Open Log", icon="TEXT").filepath = str(job.log)
        else:
            box.progress(factor=job.fraction, text=job.line)


CLASSES = (RunPanel, PreviewPanel)
