"""Build the geometry-nodes tree that draws a point cloud of splats with a material: from Blender 5.3 as its splats, before as quads."""

import bpy

from ..compat import DRAWS_SPLATS
from . import (
    add,
    add_input,
    math,
    max_component,
    modifier_tree,
    object_frame,
    out,
    read_attribute,
    scaled,
    store_attribute,
    vector_math,
)
from .doubt_material import doubt_color

NAME = "RefGS Splats"  # the tree and its modifier
# The quad reaches three standard deviations: the Gaussian is exp(-4.5) = 1.1 % of its peak there.
EXTENT = 3.0
SET_TYPE = "GeometryNodePointsSetType"
THIN = 0.05  # third scale of Blender's splats, as a part of the smaller one: with 0 they are hidden
DISPLAYS = ("Shaded", "Base Color", "Roughness", "Metallic", "Normal", "Doubt")


def draws_splats() -> bool:
    """Tell whether splats are drawn as Blender's own: from 5.3, unless the open file has the tree of an earlier Blender."""
    tree = bpy.data.node_groups.get(NAME)
    return DRAWS_SPLATS and (tree is None or any(node.bl_idname == SET_TYPE for node in tree.nodes))


def splats_tree(values_material: bpy.types.Material) -> bpy.types.NodeTree:
    """Make the node tree `RefGS Splats`, or return the existing one, which all runs share. It draws each point as a splat.

    The tree reads these attributes of the points: scale (standard deviations along two axes), rotation (quaternion), opacity 0..1, and
    base_color, roughness, metallic and normal. Points may also have doubt, 0..1: it is 1 where the photos do not show whether the surface
    is metal or paint. What is drawn keeps all attributes.

    The input Display selects what is shown. "Shaded" uses the splats' own material. Every other choice copies one attribute to `display`,
    and uses `values_material` to show it without lighting. "Doubt" is black if the points have no such attribute.
    """
    if NAME in bpy.data.node_groups:
        return bpy.data.node_groups[NAME]
    tree = modifier_tree(NAME)
    text = "Scale of all splats: small values show how they cover the surface"
    add_input(tree, "Size", "Float", text, default_value=1.0, min_value=0.0, max_value=4.0)
    limits = {"min_value": 0.0, "max_value": 1.0, "subtype": "FACTOR"}
    text = "Part of the splats to draw, enlarged to cover the same"
    add_input(tree, "Detail", "Float", text, default_value=1.0, **limits)
    add_input(tree, "Opacity Cut", "Float", "Hide splats with a lower opacity", default_value=0.0, **limits)
    add_input(tree, "Crop", "Bool", "Draw only the splats in a box")
    add_input(tree, "Crop Box", "Object", "Box that crops the splats: move, rotate and scale it")
    display = add_input(tree, "Display", "Menu", "Show the lit material, or one of its values unlit")
    add_input(tree, "Material", "Material")

    group = add(tree, "NodeGroupInput").outputs

    def attribute(name: str, kind: str) -> bpy.types.NodeSocket:
        return read_attribute(tree, name, kind)

    menu = add(tree, "GeometryNodeMenuSwitch", data_type="INT")
    menu.enum_items.clear()
    for number, name in enumerate(DISPLAYS):
        menu.enum_items.new(name)
        menu.inputs[name].default_value = number
    tree.links.new(group["Display"], menu.inputs["Menu"])
    shown = out(menu)

    opacity = {"A": attribute("opacity", "FLOAT"), "B": group["Opacity Cut"]}
    faint = out(add(tree, "FunctionNodeCompare", opacity, operation="LESS_THAN"))
    distance = {"A": max_component(tree, object_frame(tree, group["Crop Box"])[1]), "B": 1.0}
    outside = out(add(tree, "FunctionNodeCompare", distance, operation="GREATER_THAN"))
    away = add(tree, "FunctionNodeBooleanMath", {0: group["Crop"], 1: outside}, operation="AND")
    unseen = out(add(tree, "FunctionNodeBooleanMath", {0: faint, 1: out(away)}, operation="OR"))
    some = out(add(tree, "FunctionNodeRandomValue", {"Probability": group["Detail"]}, data_type="BOOLEAN"))
    unseen = out(add(tree, "FunctionNodeBooleanMath", {0: some, 1: unseen}, operation="IMPLY"))  # not drawn, or unseen
    enlarged = math(tree, "DIVIDE", group["Size"], math(tree, "SQRT", math(tree, "MAXIMUM", group["Detail"], 1e-3)))
    points = add(tree, "GeometryNodeDeleteGeometry", {"Geometry": group["Geometry"], "Selection": unseen})
    half = (0.5, 0.5, 0.5)
    doubt = add(tree, "GeometryNodeInputNamedAttribute", {"Name": "doubt"}, data_type="FLOAT")
    values = [
        attribute("base_color", "FLOAT_COLOR"),
        attribute("roughness", "FLOAT"),
        attribute("metallic", "FLOAT"),
        vector_math(tree, "MULTIPLY_ADD", attribute("normal", "FLOAT_VECTOR"), half, half),
        scaled(tree, doubt_color(tree, out(doubt)), out(doubt, "Exists")),
    ]
    value = add(tree, "GeometryNodeIndexSwitch", {"Index": shown}, data_type="RGBA")
    while len(value.index_switch_items) < len(DISPLAYS):
        value.index_switch_items.new()
    for number, source in enumerate(values, start=1):  # 0 is shaded
        tree.links.new(source, value.inputs[str(number)])
    points = store_attribute(tree, out(points), "display", "FLOAT_COLOR", out(value))

    scale = scaled(tree, attribute("scale", "FLOAT_VECTOR"), enlarged)
    drawn = (_splats if DRAWS_SPLATS else _quads)(tree, points, scale)
    is_shaded = out(add(tree, "FunctionNodeCompare", {"A": shown, "B": 0}, data_type="INT", operation="EQUAL"))
    choice = {"Switch": is_shaded, "True": group["Material"], "False": values_material}
    material = add(tree, "GeometryNodeSwitch", choice, input_type="MATERIAL")
    result = add(tree, "GeometryNodeSetMaterial", {"Geometry": drawn, "Material": out(material)})
    add(tree, "NodeGroupOutput", {"Geometry": out(result)})
    display.default_value = DISPLAYS[0]
    return tree


def _quads(tree: bpy.types.NodeTree, points, scale: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Add nodes that put a quad on each point. Its attribute `gaussian` is the position on the splat in standard deviations.

    Quads are realised, because Eevee draws them several times faster than instances.
    """
    size = {"Size X": 2 * EXTENT, "Size Y": 2 * EXTENT, "Vertices X": 2, "Vertices Y": 2}
    grid, position = out(add(tree, "GeometryNodeMeshGrid", size)), out(add(tree, "GeometryNodeInputPosition"))
    placed = {
        "Points": points,
        "Instance": store_attribute(tree, grid, "gaussian", "FLOAT_VECTOR", position),
        "Rotation": read_attribute(tree, "rotation", "QUATERNION"),
        "Scale": scale,
    }
    instances = add(tree, "GeometryNodeInstanceOnPoints", placed)
    return out(add(tree, "GeometryNodeRealizeInstances", {"Geometry": out(instances)}))


def _splats(tree: bpy.types.NodeTree, points, scale: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Add nodes that make Blender's Gaussian splats of the points, thin ones.

    Blender reads their opacity from the attribute `radiance:base`, which the points have: no node makes a vector of four components. From
    `gaussian_centre`, `gaussian_u` and `gaussian_v` (the axes over the standard deviations) the material finds where it is seen.
    """
    position = out(add(tree, "GeometryNodeInputPosition"))
    points = store_attribute(tree, points, "gaussian_centre", "FLOAT_VECTOR", position)
    x, y, _ = add(tree, "ShaderNodeSeparateXYZ", {0: scale}).outputs
    rotation = read_attribute(tree, "rotation", "QUATERNION")
    for name, side, axis in (("gaussian_u", x, "X"), ("gaussian_v", y, "Y")):
        along = out(add(tree, "ShaderNodeCombineXYZ", {axis: math(tree, "DIVIDE", 1.0, side)}))
        turned = out(add(tree, "FunctionNodeRotateVector", {"Vector": along, "Rotation": rotation}))
        points = store_attribute(tree, points, name, "FLOAT_VECTOR", turned)
    thin = math(tree, "MULTIPLY", math(tree, "MINIMUM", x, y), THIN)
    flat = out(add(tree, "ShaderNodeCombineXYZ", {"X": x, "Y": y, "Z": thin}))
    points = store_attribute(tree, points, "scale", "FLOAT_VECTOR", flat)
    return out(add(tree, SET_TYPE, {"Points": points, "Type": "3D Gaussian Splat"}))
