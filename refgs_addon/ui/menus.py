"""Add the menu RefGS to the 3D view's Object menu, so that F3 finds the panels' buttons, and imports to its Add menu."""

import bpy

from ..nodes.edit_tree import REGIONS
from ..nodes.splats_tree import NAME as SPLATS
from ..scene.run_parts import active_run, parts
from . import export_menu, light_panel, materials_panel, operators


def draw_buttons(layout: bpy.types.UILayout, *kinds: type[bpy.types.Operator]) -> None:
    """Draw an entry for each operator."""
    for kind in kinds:
        layout.operator(kind.bl_idname)


class RunMenu(bpy.types.Menu):
    bl_idname = "REFGS_MT_run"
    bl_label = "Run"

    def draw(self, context: bpy.types.Context) -> None:
        draw_buttons(self.layout, operators.ImportRun, operators.ImportExample, operators.ImportSplats)
        draw_buttons(self.layout, export_menu.ApplyEdits)
        run = active_run(context)
        for part in parts(run) if run else ():
            button = self.layout.operator(operators.ShowPart.bl_idname, text=f"Show {part.title()}")
            button.collection, button.part = run.name, part
        for splats in parts(run).get("splats", []) if run else ():
            if SPLATS in splats.modifiers:
                for operator in (operators.Crop, operators.DeleteSplats, operators.RestoreSplats):
                    self.layout.operator(operator.bl_idname).splats = splats.name


class MaterialsMenu(bpy.types.Menu):
    bl_idname = "REFGS_MT_materials"
    bl_label = "Materials"

    def draw(self, context: bpy.types.Context) -> None:
        for where in REGIONS:
            text = f"Edit Material: {where}"
            self.layout.operator(materials_panel.AddEdit.bl_idname, text=text).where = where
        self.layout.operator(materials_panel.ShowDoubt.bl_idname)


class LightMenu(bpy.types.Menu):
    bl_idname = "REFGS_MT_light"
    bl_label = "Light"

    def draw(self, context: bpy.types.Context) -> None:
        draw_buttons(self.layout, light_panel.Relight, light_panel.RecoveredLight, light_panel.MatchLight)


class PreviewMenu(bpy.types.Menu):
    bl_idname = "REFGS_MT_preview"
    bl_label = "Preview"

    def draw(self, context: bpy.types.Context) -> None:
        draw_buttons(
            self.layout,
            operators.NextCamera,
            operators.Photo,
            operators.Turntable,
            operators.RenderPreview,
            operators.ContactSheet,
            operators.MarkAsset,
        )


class Menu(bpy.types.Menu):
    bl_idname = "REFGS_MT_menu"
    bl_label = "RefGS"

    def draw(self, context: bpy.types.Context) -> None:
        for menu in (RunMenu, MaterialsMenu, LightMenu, PreviewMenu):
            self.layout.menu(menu.bl_idname)
        self.layout.operator(operators.OpenManual.bl_idname)


def _object_menu(self, context: bpy.types.Context) -> None:
    self.layout.separator()
    self.layout.menu(Menu.bl_idname)


def _add_menu(self, context: bpy.types.Context) -> None:
    self.layout.operator(operators.ImportRun.bl_idname, text="RefGS Run…", icon="POINTCLOUD_DATA")
    self.layout.operator(operators.ImportExample.bl_idname, text="RefGS Example", icon="POINTCLOUD_DATA")


CLASSES = (RunMenu, MaterialsMenu, LightMenu, PreviewMenu, Menu)


def register() -> None:
    bpy.types.VIEW3D_MT_object.append(_object_menu)
    bpy.types.VIEW3D_MT_add.append(_add_menu)


def unregister() -> None:
    bpy.types.VIEW3D_MT_add.remove(_add_menu)
    bpy.types.VIEW3D_MT_object.remove(_object_menu)
