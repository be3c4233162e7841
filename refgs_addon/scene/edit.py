"""Edits of materials: each is a modifier on the splats, that can be changed, switched off, reordered or removed at any time."""

import bpy

from .. import compat
from ..errors import InputError
from ..nodes.edit_tree import FOLLOW, NAME, REGIONS, edit_tree, follow_tree, show_edits
from ..nodes.splat_material import read_edits
from ..nodes.splats_tree import NAME as SPLATS
from .material_presets import give, read_material
from .regions import REGION, add_region
from .run_parts import parts


def add_edit(
    collection: bpy.types.Collection, where: str = "Everywhere", material: str = "Gold"
) -> bpy.types.NodesModifier:
    """Add an edit to a run's collection, on top of those that are there; its mesh, if it has one, follows.

    `where` is one of REGIONS; all but "Everywhere" get an Empty in the middle of the splats, to move, turn and scale.
    `material` is the name of a preset. "Painted" gets a copy of the mesh to paint weights on, all zero at first. Raises InputError where
    the collection has no splats, or no mesh to paint on.
    """
    if where not in REGIONS:
        raise InputError(f"there is no region {where}: take one of {', '.join(REGIONS)}")
    values = read_material(material)
    splats = splats_of(collection)
    if where == "Painted" and not parts(collection).get("mesh"):
        raise InputError(f"{collection.name} has no mesh to paint on: make the run's mesh, and import it again")
    edit = splats.modifiers.new(NAME, "NODES")
    edit.node_group = edit_tree()
    splats.modifiers.move(len(splats.modifiers) - 1, splats.modifiers.find(SPLATS))
    edit = splats.modifiers[edit.name]
    compat.set_modifier_input(edit, "Where", where)
    if where == "Painted":
        canvas, group = _canvas(parts(collection)["mesh"][0], collection)
        for name, value in (("Region", canvas), ("Painted", group), ("Falloff", 1.0)):
            compat.set_modifier_input(edit, name, value)
    elif where != "Everywhere":
        compat.set_modifier_input(edit, "Region", _region(splats, collection, where))
    give(edit, values)
    read_edits(splats.data.materials[0])
    for mesh in parts(collection).get("mesh", []):
        _follow(mesh, splats)
    return edit


def edits(splats: bpy.types.Object) -> list[bpy.types.NodesModifier]:
    """The edits of splats, in the order in which they are applied."""
    return [m for m in splats.modifiers if m.type == "NODES" and m.node_group and m.node_group.name == NAME]


def remove_edit(splats: bpy.types.Object, name: str) -> None:
    """Remove an edit, and its region where no other edit has it."""
    edit = splats.modifiers.get(name)
    if edit is None or edit not in edits(splats):
        raise InputError(f"{splats.name} has no edit {name}")
    region = compat.get_modifier_input(edit, "Region")
    splats.modifiers.remove(edit)
    shared = any(compat.get_modifier_input(other, "Region") == region for other in edits(splats))
    if region is not None and region.get(REGION) and not shared:
        bpy.data.objects.remove(region)


def splats_of(collection: bpy.types.Collection) -> bpy.types.Object:
    """The splats of a run's collection. Raises InputError where it has none."""
    found = parts(collection).get("splats", [])
    if not found or SPLATS not in found[0].modifiers:
        raise InputError(f"{collection.name} has no splats: import a RefGS run")
    return found[0]


def _region(splats: bpy.types.Object, collection: bpy.types.Collection, where: str) -> bpy.types.Object:
    """An Empty in the middle of the splats, a third of their size; for "Similar" a small one, to be put on a splat."""
    shape = {"Box": "CUBE", "Sphere": "SPHERE", "Similar": "ARROWS"}[where]
    region = add_region(splats, collection, f"{where} of {splats.name}", shape)
    region.scale = [max(region.scale) * (1 / 6 if where == "Similar" else 1 / 3)] * 3
    return region


def _canvas(mesh: bpy.types.Object, collection: bpy.types.Collection) -> tuple[bpy.types.Object, str]:
    """What is painted on, and its new vertex group. It shares the mesh but not its modifiers: those follow the splats, which follow
    what is painted."""
    found = [item for item in collection.objects if item.get(REGION) and item.data == mesh.data]
    if found:
        canvas = found[0]
    else:
        canvas = bpy.data.objects.new(f"{mesh.name} to paint on", mesh.data)
        canvas[REGION] = canvas.hide_render = True
        canvas.matrix_world = mesh.matrix_world
        collection.objects.link(canvas)
    group = canvas.vertex_groups.new(name="RefGS Painted")
    canvas.vertex_groups.active = group
    return canvas, group.name


def _follow(mesh: bpy.types.Object, splats: bpy.types.Object) -> None:
    if FOLLOW not in mesh.modifiers:
        modifier = mesh.modifiers.new(FOLLOW, "NODES")
        modifier.node_group = follow_tree()
        compat.set_modifier_input(modifier, "Splats", splats)
    for material in mesh.data.materials:
        if material is not None and material.node_tree is not None:
            show_edits(material)
