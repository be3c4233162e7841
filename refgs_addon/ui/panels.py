"""The RefGS tab in the 3D viewport's sidebar."""

import bpy

from .. import compat
from ..nodes.splats import NAME as MODIFIER
from ..nodes.world import IMAGE, RECOVERED, ROTATION, STRENGTH, is_panorama
from ..scene.parts import parts
from . import operators


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
        for collection in context.scene.collection.children:
            if found := parts(collection):
                self._run(layout.box(), collection, found)

    def _run(self, layout: bpy.types.UILayout, collection: bpy.types.Collection, found: dict) -> None:
        layout.label(text=collection.name, icon="POINTCLOUD_DATA")
        row = layout.row(align=True)
        for part, items in found.items():
            button = row.operator(operators.ShowPart.bl_idname, text=part.title(), depress=not items[0].hide_viewport)
            button.collection, button.part = collection.name, part
        for splats in found.get("splats", []):
            if splats.hide_viewport or MODIFIER not in splats.modifiers:
                continue
            column = layout.column()
            column.use_property_split, column.use_property_decorate = True, False
            for name in ("Display", "Size", "Opacity Cut"):
                owner, path = compat.modifier_input(splats.modifiers[MODIFIER], name)
                column.prop(owner, path, text=name)
            layout.label(text=f"{len(splats.data.points):,} splats")


class LightPanel(Tab, bpy.types.Panel):
    bl_idname = "REFGS_PT_light"
    bl_label = "Light"
    bl_order = 3

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        world = context.scene.world
        column = layout.column(align=True)
        column.operator(operators.Relight.bl_idname, icon="WORLD")
        if not is_panorama(world):
            return
        if world.get(RECOVERED) is not None:
            column.operator(operators.RecoveredLight.bl_idname, icon="LOOP_BACK")
        nodes = world.node_tree.nodes
        layout.label(text=nodes[IMAGE].image.name, icon="IMAGE_DATA")
        column = layout.column()
        column.use_property_split, column.use_property_decorate = True, False
        column.prop(nodes[ROTATION].inputs["Rotation"], "default_value", index=2, text="Rotation")
        column.prop(nodes[STRENGTH].inputs["Strength"], "default_value", text="Strength")


class PreviewPanel(Tab, bpy.types.Panel):
    bl_idname = "REFGS_PT_preview"
    bl_label = "Preview"
    bl_order = 4

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        layout.prop(context.scene, "camera", text="Camera")
        layout.operator(operators.RenderPreview.bl_idname, icon="RENDER_STILL")


CLASSES = (RunPanel, LightPanel, PreviewPanel)
