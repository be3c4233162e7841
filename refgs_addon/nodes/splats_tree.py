"""The geometry-nodes tree that turns a point cloud of splats into quads with a material."""

import bpy

from . import add, largest, modifier_tree, out, seen_from

NAME = "RefGS Splats"  # of the tree, and of the modifier that uses it
# The quad reaches three standard deviations: the Gaussian is exp(-4.5) = 1.1 % of its peak there.
EXTENT = 3.0
DISPLAYS = ("Shaded", "Base Color", "Roughness", "Metallic", "Normal")


def splats_tree(values_material: bpy.types.Material) -> bpy.types.NodeTree:
    """The tree `RefGS Splats`, made the first time and shared by all runs in the file.

    On its points it reads scale (2 standard deviations, world units), rotation (quaternion), opacity 0..1, and for the
    displays base_color, roughness, metallic and normal. Its quads carry all of the points' attributes, and
    `gaussian`: the position on the splat in standard deviations. Quads are realised: Eevee draws them several times
    faster than instances. `values_material` draws the attribute `display` in the displays that are not shaded.
    """
    if NAME in bpy.data.node_groups:
        return bpy.data.node_groups[NAME]
    tree = modifier_tree(NAME)
    interface = tree.interface
    size = interface.new_socket("Size", in_out="INPUT", socket_type="NodeSocketFloat")
    size.default_value, size.min_value, size.max_value = 1.0, 0.0, 4.0
    size.description = "Scale of every splat: small values show how the surface is covered"
    cut = interface.new_socket("Opacity Cut", in_out="INPUT", socket_type="NodeSocketFloat")
    cut.default_value, cut.min_value, cut.max_value, cut.subtype = 0.0, 0.0, 1.0, "FACTOR"
    cut.description = "Hide splats fainter than this"
    interface.new_socket(
        "Crop", in_out="INPUT", socket_type="NodeSocketBool"
    ).description = "Draw only the splats in a box"
    interface.new_socket(
        "Crop Box", in_out="INPUT", socket_type="NodeSocketObject"
    ).description = "Move, turn and scale it"
    display = interface.new_socket("Display", in_out="INPUT", socket_type="NodeSocketMenu")
    display.description = "What the splats show: the material under the light, or one of its values as it is"
    interface.new_socket("Material", in_out="INPUT", socket_type="NodeSocketMaterial")

    group = add(tree, "NodeGroupInput").outputs

    def attribute(name: str, kind: str) -> bpy.types.NodeSocket:
        return out(add(tree, "GeometryNodeInputNamedAttribute", {"Name": name}, data_type=kind))

    menu = add(tree, "GeometryNodeMenuSwitch", data_type="INT")
    menu.enum_items.clear()
    for number, name in enumerate(DISPLAYS):
        menu.enum_items.new(name)
        menu.inputs[name].default_value = number
    tree.links.new(group["Display"], menu.inputs["Menu"])
    shown = out(menu)

    faint = add(
        tree,
        "FunctionNodeCompare",
        {"A": attribute("opacity", "FLOAT"), "B": group["Opacity Cut"]},
        operation="LESS_THAN",
    )
    outside = add(
        tree,
        "FunctionNodeCompare",
        {"A": largest(tree, seen_from(tree, group["Crop Box"])[1]), "B": 1.0},
        operation="GREATER_THAN",
    )
    away = add(tree, "FunctionNodeBooleanMath", {0: group["Crop"], 1: out(outside)}, operation="AND")
    unseen = out(add(tree, "FunctionNodeBooleanMath", {0: out(faint), 1: out(away)}, operation="OR"))
    points = add(tree, "GeometryNodeDeleteGeometry", {"Geometry": group["Geometry"], "Selection": unseen})
    normal = add(
        tree,
        "ShaderNodeVectorMath",
        {0: attribute("normal", "FLOAT_VECTOR"), 1: (0.5, 0.5, 0.5), 2: (0.5, 0.5, 0.5)},
        operation="MULTIPLY_ADD",
    )
    values = [
        attribute("base_color", "FLOAT_COLOR"),
        attribute("roughness", "FLOAT"),
        attribute("metallic", "FLOAT"),
        out(normal),
    ]
    value = add(tree, "GeometryNodeIndexSwitch", {"Index": shown}, data_type="RGBA")
    while len(value.index_switch_items) < len(DISPLAYS):
        value.index_switch_items.new()
    for number, source in enumerate(values, start=1):  # 0, shaded, shows no value
        tree.links.new(source, value.inputs[str(number)])
    points = add(
        tree,
        "GeometryNodeStoreNamedAttribute",
        {"Geometry": out(points), "Name": "display", "Value": out(value)},
        data_type="FLOAT_COLOR",
    )

    grid = add(
        tree, "GeometryNodeMeshGrid", {"Size X": 2 * EXTENT, "Size Y": 2 * EXTENT, "Vertices X": 2, "Vertices Y": 2}
    )
    quad = add(
        tree,
        "GeometryNodeStoreNamedAttribute",
        {"Geometry": out(grid), "Name": "gaussian", "Value": out(add(tree, "GeometryNodeInputPosition"))},
        data_type="FLOAT_VECTOR",
    )
    scale = add(
        tree,
        "ShaderNodeVectorMath",
        {"Vector": attribute("scale", "FLOAT_VECTOR"), "Scale": group["Size"]},
        operation="SCALE",
    )
    instances = add(
        tree,
        "GeometryNodeInstanceOnPoints",
        {
            "Points": out(points),
            "Instance": out(quad),
            "Rotation": attribute("rotation", "QUATERNION"),
            "Scale": out(scale),
        },
    )
    realised = add(tree, "GeometryNodeRealizeInstances", {"Geometry": out(instances)})
    material = add(
        tree,
        "GeometryNodeSwitch",
        {
            "Switch": out(add(tree, "FunctionNodeCompare", {"A": shown, "B": 0}, data_type="INT", operation="EQUAL")),
            "True": group["Material"],
            "False": values_material,
        },
        input_type="MATERIAL",
    )
    result = add(tree, "GeometryNodeSetMaterial", {"Geometry": out(realised), "Material": out(material)})
    add(tree, "NodeGroupOutput", {"Geometry": out(result)})
    display.default_value = DISPLAYS[0]
    return tree
