"""Show a run in less detail: fewer splats, and a mesh of fewer triangles."""

import bpy

from .. import compat
from ..nodes.splats_tree import NAME as SPLATS
from .run_parts import parts

NAME = "RefGS Detail"  # the mesh's modifier
LEVELS = (1.0, 0.25, 0.05)  # parts of the splats and triangles


def set_detail(collection: bpy.types.Collection, level: float) -> None:
    """Show only the fraction `level`, 0 to 1, of a run's splats and of its mesh's triangles.

    The splats that are shown are enlarged, so that they cover the same surface.
    """
    found = parts(collection)
    for splats in found.get("splats", []):
        if SPLATS in splats.modifiers:
            compat.set_modifier_input(splats.modifiers[SPLATS], "Detail", level)
    for mesh in found.get("mesh", []):
        modifier = mesh.modifiers.get(NAME) or mesh.modifiers.new(NAME, "DECIMATE")
        mesh.modifiers.move(mesh.modifiers.find(NAME), 0)
        modifier.ratio = level  # at 1 it does nothing


def detail(collection: bpy.types.Collection) -> float:
    """Return the shown fraction of a run's splats and triangles, 0 to 1."""
    splats = parts(collection).get("splats", [])
    if not splats or SPLATS not in splats[0].modifiers:
        return 1.0
    return compat.get_modifier_input(splats[0].modifiers[SPLATS], "Detail")
