"""Draw the Materials panel, in which the artist changes the materials of a run's splats."""

from pathlib import Path
from typing import ClassVar

import bpy
from bl_ui.utils import PresetPanel
from bpy.props import BoolProperty, EnumProperty, StringProperty

from .. import compat
from ..errors import InputError
from ..nodes.edit_tree import REGIONS
from ..preferences import letters, wrapped_text
from ..scene.doubt import doubt_shown, doubt_words, has_doubt, show_doubt
from ..scene.edit import add_edit, edits, remove_edit
from ..scene.material_presets import (
    ROOT,
    is_own,
    materials,
    read_material,
    remove_material,
    save_material,
    set_material,
)
from ..scene.run_parts import active_run, parts
from .export_menu import ApplyEdits
from .icons import swatch
from .operators import OnRun, ReportsErrors, select_only, show_materials
from .panels import Tab

_WHERE = {
    "Everywhere": ("Edit the whole object", "WORLD"),
    "Box": ("Edit a box that you move, rotate and scale", "MESH_CUBE"),
    "Sphere": ("Edit a ball that you move, rotate and scale", "MESH_UVSPHERE"),
    "Painted": ("Edit the area that you paint on the mesh", "BRUSH_DATA"),
    "Similar": ("Edit all places with a material like the one at a point that you move", "EYEDROPPER"),
}


class ShowDoubt(OnRun, bpy.types.Operator):
    bl_idname = "refgs.show_doubt"
    bl_label = "Show Where Photos Do Not Tell"
    bl_description = "Colour the run orange where its photos do not tell metal from paint; or show its materials again"

    on: BoolProperty(name="Show", default=True)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not super().poll(context):
            return False
        cls.poll_message_set(
            "This run does not say where photos do not tell: they tell everywhere, or it is of an earlier RefGS"
        )
        return has_doubt(active_run(context))

    def work(self, context: bpy.types.Context) -> None:
        show_doubt(active_run(context), self.on)
        if self.on:
            show_materials(context)


class AddEdit(OnRun, bpy.types.Operator):
    bl_idname = "refgs.add_edit"
    bl_label = "Edit Material"
    bl_description = "Edit the material of the object or a part of it. The learned material is kept"

    where: EnumProperty(
        name="Where", items=[(name, name, _WHERE[name][0], _WHERE[name][1], i) for i, name in enumerate(REGIONS)]
    )
    material: StringProperty(
        name="Material",
        description="Preset to start from",
        default="Gold",
        search=lambda operator, context, text: [*materials()],
    )

    def work(self, context: bpy.types.Context) -> None:
        edit = add_edit(active_run(context), self.where, self.material)
        region = compat.get_modifier_input(edit, "Region")
        if region is not None:
            select_only(context, region)
        show_materials(context)
        if self.where == "Painted" and context.area is not None:
            bpy.ops.object.mode_set(mode="WEIGHT_PAINT")


class _OfEdit(ReportsErrors):
    """Store the edit (a modifier of the object `splats`) that an operator works on."""

    splats: StringProperty(name="Splats", options={"HIDDEN"})
    edit: StringProperty(name="Edit", options={"HIDDEN"})

    def modifier(self) -> bpy.types.NodesModifier:
        return bpy.data.objects[self.splats].modifiers[self.edit]


class RemoveEdit(_OfEdit, bpy.types.Operator):
    bl_idname = "refgs.remove_edit"
    bl_label = "Remove Edit"
    bl_description = "Remove this edit, and show the learned material again"

    def work(self, context: bpy.types.Context) -> None:
        remove_edit(bpy.data.objects[self.splats], self.edit)


class PaintEdit(_OfEdit, bpy.types.Operator):
    bl_idname = "refgs.paint_edit"
    bl_label = "Paint"
    bl_description = "Paint where this edit applies. Splats and Mesh in the panel Run end it, and show the result"

    def work(self, context: bpy.types.Context) -> None:
        edit = self.modifier()
        canvas = compat.get_modifier_input(edit, "Region")
        if canvas is None or canvas.name not in context.view_layer.objects:
            raise InputError(f"the object to paint on of {edit.name} was deleted: remove the edit and add another one")
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        select_only(context, canvas)
        group = canvas.vertex_groups.get(compat.get_modifier_input(edit, "Painted"))
        if group is not None:
            canvas.vertex_groups.active = group
        bpy.ops.object.mode_set(mode="WEIGHT_PAINT")


class SetMaterial(_OfEdit, bpy.types.Operator):
    """Set the values of an edit to those of a material preset.

    Blender's own operator for presets does the same, but its changes cannot be undone.
    """

    bl_idname = "refgs.set_material"
    bl_label = "Set Material"
    bl_description = "Set this edit to the values of a material"

    material: StringProperty(name="Material", description="Name of the preset", options={"HIDDEN"})

    def work(self, context: bpy.types.Context) -> None:
        set_material(self.modifier(), self.material)


class KeepMaterial(_OfEdit, bpy.types.Operator):
    """Save the values of an edit as a material preset, or remove a preset. Its buttons are + and − beside the list of presets.

    Blender's own operator for presets cannot do this, because it does not read the inputs of a modifier. In Blender 4.3 it also overwrites
    a preset of the same name.
    """

    bl_idname = "refgs.keep_material"
    bl_label = "Save or Remove Material"
    bl_options: ClassVar = {"INTERNAL"}

    name: StringProperty(name="Name", description="Name of the preset")
    remove_name: BoolProperty(name="Remove", description="Remove the preset of this name")

    @classmethod
    def description(cls, context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        if properties.remove_name:
            return "Remove this preset. Only presets that you saved can be removed"
        return "Save this edit's material as a preset with the name on the left"

    def work(self, context: bpy.types.Context) -> None:
        if self.remove_name:
            remove_material(self.name)
        else:
            save_material(self.modifier(), self.name)


class MaterialPresets(PresetPanel, bpy.types.Panel):
    bl_idname = "REFGS_PT_material_presets"
    bl_label = "Materials"

    def draw(self, context: bpy.types.Context) -> None:
        layout, edit, manager = self.layout, context.refgs_edit, context.window_manager
        layout.emboss, layout.operator_context = "PULLDOWN_MENU", "EXEC_DEFAULT"
        column = layout.column(align=True)
        for name, file in materials().items():
            row = column.row(align=True)
            button = row.operator(SetMaterial.bl_idname, text=name, icon_value=_swatch(name, file), translate=False)
            button.splats, button.edit, button.material = edit.id_data.name, edit.name, name
            if is_own(file):
                button = row.operator(KeepMaterial.bl_idname, text="", icon="REMOVE")
                button.name, button.remove_name = name, True
        layout.separator()
        row = layout.row()
        field = row.row()
        field.emboss = "NORMAL"
        field.prop(manager, "preset_name", text="")
        button = row.operator(KeepMaterial.bl_idname, text="", icon="ADD")
        button.splats, button.edit, button.name = edit.id_data.name, edit.name, manager.preset_name


def _swatch(name: str, file: Path) -> int:
    """Return the number of a preset's icon, 0 if the preset cannot be read."""
    try:
        return swatch(file, read_material(name))
    except InputError:
        return 0


class MaterialPanel(Tab, bpy.types.Panel):
    bl_idname = "REFGS_PT_materials"
    bl_label = "Materials"
    bl_order = 2

    def draw(self, context: bpy.types.Context) -> None:
        layout, run = self.layout, active_run(context)
        if run and has_doubt(run):
            self._doubt(layout, run, context)
        layout.operator_menu_enum(AddEdit.bl_idname, "where", text="Edit Material", icon="ADD")
        for splats in parts(run).get("splats", []) if run else ():
            for edit in edits(splats):
                self._edit(layout.box(), edit)
            if edits(splats):
                layout.operator(ApplyEdits.bl_idname, icon="CHECKMARK")

    def _doubt(self, layout: bpy.types.UILayout, run: bpy.types.Collection, context: bpy.types.Context) -> None:
        width = letters(context)
        if words := doubt_words(run):
            wrapped_text(layout, words[0].upper() + words[1:], width, "QUESTION")
        on = doubt_shown(run)
        layout.operator(ShowDoubt.bl_idname, icon="HIDE_OFF" if on else "HIDE_ON", depress=on).on = not on

    def _edit(self, box: bpy.types.UILayout, edit: bpy.types.NodesModifier) -> None:
        row = box.row(align=True)
        row.prop(edit, "name", text="")
        row.context_pointer_set("refgs_edit", edit)
        row.popover(MaterialPresets.bl_idname, text="", icon="PRESET")
        row.prop(edit, "show_viewport", text="")
        row.prop(edit, "show_render", text="")
        button = row.operator(RemoveEdit.bl_idname, text="", icon="X")
        button.splats, button.edit = edit.id_data.name, edit.name
        column = box.column()
        column.use_property_split, column.use_property_decorate = True, False
        where = compat.get_modifier_input(edit, "Where")
        if where == "Painted":
            button = column.operator(PaintEdit.bl_idname, icon="BRUSH_DATA")
            button.splats, button.edit = edit.id_data.name, edit.name
        names = ["Where"] + ([] if where == "Everywhere" else ["Region", "Falloff"])
        for name in names + (["Tolerance"] if where == "Similar" else []):
            self._input(column, edit, name, name)
        for name, amount in (
            ("Base Color", "Color Amount"),
            ("Metallic", "Metallic Amount"),
            ("Roughness", "Roughness Amount"),
        ):
            group = column.column(align=True)
            self._input(group, edit, name, name)
            self._input(group, edit, amount, "Amount")

    def _input(self, layout: bpy.types.UILayout, edit: bpy.types.NodesModifier, name: str, text: str) -> None:
        owner, path = compat.modifier_input(edit, name)
        if name == "Region" and path != "value":
            layout.prop_search(owner, path, bpy.data, "objects", text=text)
        else:
            layout.prop(owner, path, text=text)


CLASSES = (ShowDoubt, AddEdit, RemoveEdit, PaintEdit, SetMaterial, KeepMaterial, MaterialPresets, MaterialPanel)


def register() -> None:
    bpy.utils.register_preset_path(str(ROOT))


def unregister() -> None:
    bpy.utils.unregister_preset_path(str(ROOT))
