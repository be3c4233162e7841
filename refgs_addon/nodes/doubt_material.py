"""Build the material that shows a run's doubt as colours.

Doubt is 0 where the photos show whether the surface is metal or paint, and 1 where they do not.
"""

import bpy

from ..compat import node_tree
from ..scene.color_spaces import from_rec709
from . import add, add_input, modifier_tree, out

NAME = "RefGS Doubt"  # the mesh's tree and modifier
# Linear Rec.709 colours where photos tell, and where they do not: those of the report's pictures, backend/refgs/compare/pictures.py.
TOLD, DOUBTFUL = (0.089, 0.1, 0.119, 1.0), (1.0, 0.319, 0.02, 1.0)


def doubt_color(tree: bpy.types.NodeTree, doubt: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Add a node that turns doubt into a colour: grey for 0, orange for 1."""
    colors = {"A": from_rec709(TOLD), "B": from_rec709(DOUBTFUL)}
    return out(add(tree, "ShaderNodeMix", {"Factor": doubt, **colors}, data_type="RGBA"))


def doubt_material(name: str, texture: bpy.types.Image) -> bpy.types.Material:
    """Make a material that shows a texture's doubt, 0..1, as colours without lighting."""
    material = bpy.data.materials.new(name)
    tree = node_tree(material)
    doubt = add(tree, "ShaderNodeTexImage", image=texture).outputs["Color"]
    shown = add(tree, "ShaderNodeEmission", {"Color": doubt_color(tree, doubt)})
    add(tree, "ShaderNodeOutputMaterial", {"Surface": out(shown)})
    return material


def doubt_tree() -> bpy.types.NodeTree:
    """Make or reuse the node tree whose input Material replaces the material of a mesh."""
    if NAME in bpy.data.node_groups:
        return bpy.data.node_groups[NAME]
    tree = modifier_tree(NAME)
    add_input(tree, "Material", "Material")
    group = add(tree, "NodeGroupInput").outputs
    colored = {"Geometry": group["Geometry"], "Material": group["Material"]}
    add(tree, "NodeGroupOutput", {"Geometry": out(add(tree, "GeometryNodeSetMaterial", colored))})
    return tree
