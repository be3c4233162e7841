"""Colour a run by its doubt: 0 where the photos show whether the surface is metal or paint, and 1 where they do not."""

from pathlib import Path

import bpy

from .. import compat
from ..errors import InputError
from ..nodes.doubt_material import NAME, doubt_material, doubt_tree
from ..nodes.splats_tree import NAME as SPLATS
from .run_parts import DOUBT, parts, shown

DISPLAY = "Doubt"  # of the splats' modifier


def has_doubt(collection: bpy.types.Collection) -> bool:
    """Check whether a run's splats have the attribute `doubt`."""
    return any("doubt" in splats.data.attributes for splats in parts(collection).get("splats", []))


def doubt_words(collection: bpy.types.Collection) -> str:
    """Return the trainer's sentence on a run's doubt, or "" if there is none."""
    return collection.get(DOUBT, "")


def doubt_shown(collection: bpy.types.Collection) -> bool:
    """Check whether the shown part of a run, splats or mesh, is coloured by doubt."""
    found = parts(collection)
    if shown(collection) == "mesh":
        return any(NAME in mesh.modifiers for mesh in found.get("mesh", []))
    drawing = [splats.modifiers[SPLATS] for splats in found.get("splats", []) if SPLATS in splats.modifiers]
    return any(compat.get_modifier_input(modifier, "Display") == DISPLAY for modifier in drawing)


def show_doubt(collection: bpy.types.Collection, on: bool) -> None:
    """Colour a run's splats and mesh by their doubt, without lighting. If `on` is false, show them shaded again.

    A surface is orange where the photos do not show whether it is metal or paint, and grey where they do. The mesh's colours come from the
    file textures/doubt.png in the run folder. Raises InputError if the mesh is shown and this file is missing.
    """
    from .export_run import run_folder  # needs numpy, which Debian's Blender may lack
    from .mesh_exchange import TEXTURES

    meshes = parts(collection).get("mesh", [])
    for mesh in meshes:
        _remove(mesh)
    if on and meshes:
        file = run_folder(collection) / TEXTURES / "doubt.png"
        if file.is_file():
            for mesh in meshes:
                _add(mesh, file)
        elif shown(collection) == "mesh":
            raise InputError(f"{file} does not exist: show the splats, or make the run's mesh again and import the run")
    for splats in parts(collection).get("splats", []):
        if SPLATS in splats.modifiers:
            compat.set_modifier_input(splats.modifiers[SPLATS], "Display", DISPLAY if on else "Shaded")


def _add(mesh: bpy.types.Object, file: Path) -> None:
    texture = bpy.data.images.load(str(file))
    texture.colorspace_settings.is_data = True
    texture.pack()
    modifier = mesh.modifiers.new(NAME, "NODES")
    modifier.node_group = doubt_tree()
    bpy.context.view_layer.update()  # 5.2 creates the modifier's inputs here
    compat.set_modifier_input(modifier, "Material", doubt_material(f"{mesh.name} doubt", texture))


def _remove(mesh: bpy.types.Object) -> None:
    modifier = mesh.modifiers.get(NAME)
    if modifier is None:
        return
    material = compat.get_modifier_input(modifier, "Material")
    mesh.modifiers.remove(modifier)
    if material is not None:
        textures = [node.image for node in material.node_tree.nodes if node.type == "TEX_IMAGE" and node.image]
        bpy.data.batch_remove([material, *textures])
