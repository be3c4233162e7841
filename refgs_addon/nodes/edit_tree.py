"""Trees that change the splats' materials without touching what was learned, and that carry the changes over to the mesh."""

import bpy

from . import add, largest, math, modifier_tree, out, seen_from

NAME = "RefGS Edit"  # of the tree, and the beginning of the names of modifiers that use it
FOLLOW = "RefGS Follow"  # of the mesh's tree and modifier
REGIONS = ("Everywhere", "Box", "Sphere", "Similar", "Painted")
# What the edits so far have made of a point: values times how much of them there is, as in alpha compositing, and how much that is, of
# the colour, of the metallic and of the roughness.
COLOR, SURFACE, AMOUNT = "edit_color", "edit_surface", "edit_amount"
_MIXED = "RefGS Edited"  # the node of a mesh's material that says it knows the edits


def edit_tree() -> bpy.types.NodeTree:
    """The tree `RefGS Edit`, made the first time and shared by all edits in the file.

    Where its mask is one the splats' base_color, metallic and roughness become its own, as far as the amounts say. The mask
    is one inside a box or a ball of the size of the object Region, an Empty of size 1, and falls to zero towards its border over the part
    Falloff; with "Similar" it is one where the material is that of the splat nearest to the object, and zero where it differs by more
    than Tolerance; with "Painted" it is, as far as Falloff says, the weight of the vertex group Painted of the object, a mesh, where that
    is nearest to the splat.
    """
    if NAME in bpy.data.node_groups:
        return bpy.data.node_groups[NAME]
    tree = modifier_tree(NAME)
    interface = tree.interface
    where = interface.new_socket("Where", in_out="INPUT", socket_type="NodeSocketMenu")
    where.description = (
        "Which splats: all, those in a box or a ball, those of a material like the one that the region stands at, "
        "or what is painted on a mesh"
    )
    interface.new_socket(
        "Region", in_out="INPUT", socket_type="NodeSocketObject"
    ).description = "Move, turn and scale it"
    interface.new_socket(
        "Painted", in_out="INPUT", socket_type="NodeSocketString"
    ).description = "The vertex group of the region that is painted"
    factors = {
        "Falloff": (0.2, "How much of the region is its soft border"),
        "Tolerance": (0.2, "How much a material may differ from the one at the region and still be changed"),
        "Color Amount": (1.0, "How much of the base colour is replaced"),
        "Metallic": (1.0, "Metallic of what is changed"),
        "Metallic Amount": (1.0, "How much of the metallic is replaced"),
        "Roughness": (0.2, "Roughness of what is changed"),
        "Roughness Amount": (1.0, "How much of the roughness is replaced"),
    }
    color = interface.new_socket("Base Color", in_out="INPUT", socket_type="NodeSocketColor")
    color.default_value, color.description = (1.0, 0.77, 0.34, 1.0), "Base colour of what is changed"
    for name, (value, description) in factors.items():
        socket = interface.new_socket(name, in_out="INPUT", socket_type="NodeSocketFloat")
        socket.default_value, socket.min_value, socket.max_value, socket.subtype = value, 0.0, 1.0, "FACTOR"
        socket.description = description

    group = add(tree, "NodeGroupInput").outputs
    mask = _mask(tree, group)
    by_color, by_metallic, by_roughness = (
        math(tree, "MULTIPLY", mask, group[f"{name} Amount"]) for name in ("Color", "Metallic", "Roughness")
    )
    surface = out(add(tree, "ShaderNodeCombineXYZ", {"X": group["Metallic"], "Y": group["Roughness"]}))
    surface_amount = out(add(tree, "ShaderNodeCombineXYZ", {"X": by_metallic, "Y": by_roughness}))
    amount = out(add(tree, "ShaderNodeCombineXYZ", {"X": by_color, "Y": by_metallic, "Z": by_roughness}))
    color_amount = out(add(tree, "ShaderNodeCombineXYZ", {"X": by_color, "Y": by_color, "Z": by_color}))
    changed = [
        ("base_color", "FLOAT_COLOR", "RGBA", by_color, group["Base Color"]),
        ("metallic", "FLOAT", "FLOAT", by_metallic, group["Metallic"]),
        ("roughness", "FLOAT", "FLOAT", by_roughness, group["Roughness"]),
        (COLOR, "FLOAT_VECTOR", "VECTOR", color_amount, group["Base Color"]),
        (SURFACE, "FLOAT_VECTOR", "VECTOR", surface_amount, surface),
        (AMOUNT, "FLOAT_VECTOR", "VECTOR", amount, (1.0, 1.0, 1.0)),
    ]
    # All are read before any is written: where the mask asks for similar splats, it is by what they were.
    values = {}
    for name, kind, mix, factor, value in changed:
        mixed = {"Factor": factor, "A": _attribute(tree, name, kind), "B": value}
        by = "NON_UNIFORM" if mix == "VECTOR" else "UNIFORM"
        values[name] = kind, out(add(tree, "ShaderNodeMix", mixed, data_type=mix, factor_mode=by))
    geometry = add(tree, "GeometryNodeCaptureAttribute", {"Geometry": group["Geometry"]}, domain="POINT")
    for name, (kind, _) in values.items():
        geometry.capture_items.new({"FLOAT_COLOR": "RGBA", "FLOAT_VECTOR": "VECTOR", "FLOAT": "FLOAT"}[kind], name)
    stored = geometry.outputs["Geometry"]
    for name, (_, value) in values.items():
        tree.links.new(value, geometry.inputs[name])
    for name, (kind, _) in values.items():
        store = {"Geometry": stored, "Name": name, "Value": geometry.outputs[name]}
        stored = out(add(tree, "GeometryNodeStoreNamedAttribute", store, data_type=kind))
    add(tree, "NodeGroupOutput", {"Geometry": stored})
    return tree


def _mask(tree: bpy.types.NodeTree, group: bpy.types.NodeOutputs) -> bpy.types.NodeSocket:
    """How much each splat is changed, 0..1."""
    menu = add(tree, "GeometryNodeMenuSwitch", data_type="FLOAT")
    menu.enum_items.clear()
    for name in REGIONS:
        menu.enum_items.new(name)
    tree.links.new(group["Where"], menu.inputs["Menu"])
    region, inside = seen_from(tree, group["Region"])
    box = largest(tree, inside)
    ball = add(tree, "ShaderNodeVectorMath", {0: inside}, operation="LENGTH").outputs["Value"]
    nearest = add(
        tree,
        "GeometryNodeSampleNearest",
        {"Geometry": group["Geometry"], "Sample Position": region.outputs["Location"]},
    )
    squares = []
    for name, kind in (("base_color", "FLOAT_VECTOR"), ("metallic", "FLOAT"), ("roughness", "FLOAT")):
        value = _attribute(tree, name, kind)
        sample = {"Geometry": group["Geometry"], "Value": value, "Index": out(nearest)}
        there = add(tree, "GeometryNodeSampleIndex", sample, data_type=kind)
        if kind == "FLOAT":
            squares.append(math(tree, "POWER", math(tree, "SUBTRACT", value, out(there)), 2.0))
        else:
            apart = out(add(tree, "ShaderNodeVectorMath", {0: value, 1: out(there)}, operation="SUBTRACT"))
            squares.append(
                add(tree, "ShaderNodeVectorMath", {0: apart, 1: apart}, operation="DOT_PRODUCT").outputs["Value"]
            )
    unlike = math(tree, "SQRT", math(tree, "ADD", math(tree, "ADD", *squares[:2]), squares[2]))
    unlike = math(tree, "DIVIDE", unlike, math(tree, "MAXIMUM", group["Tolerance"], 1e-6))
    position = out(add(tree, "GeometryNodeInputPosition"))
    weight = {"Mesh": region.outputs["Geometry"], "Sample Position": position}
    weight["Value"] = add(
        tree, "GeometryNodeInputNamedAttribute", {"Name": group["Painted"]}, data_type="FLOAT"
    ).outputs["Attribute"]
    painted = out(add(tree, "GeometryNodeSampleNearestSurface", weight, data_type="FLOAT"))
    tree.links.new(math(tree, "SUBTRACT", 1.0, painted), menu.inputs["Painted"])
    tree.links.new(box, menu.inputs["Box"])
    tree.links.new(ball, menu.inputs["Sphere"])
    tree.links.new(unlike, menu.inputs["Similar"])
    menu.inputs["Everywhere"].default_value = 0.0
    begin = math(tree, "SUBTRACT", 0.9999, group["Falloff"])
    falling = add(
        tree,
        "ShaderNodeMapRange",
        {"Value": out(menu), "From Min": begin, "From Max": 1.0, "To Min": 1.0, "To Max": 0.0},
        interpolation_type="SMOOTHSTEP",
    )
    tree.interface.items_tree["Where"].default_value = REGIONS[0]
    return out(falling)


def follow_tree() -> bpy.types.NodeTree:
    """The tree `RefGS Follow`: each corner of a mesh takes the edits of the splat nearest to it, both being in the run's frame."""
    if FOLLOW in bpy.data.node_groups:
        return bpy.data.node_groups[FOLLOW]
    tree = modifier_tree(FOLLOW)
    tree.interface.new_socket("Splats", in_out="INPUT", socket_type="NodeSocketObject")
    group = add(tree, "NodeGroupInput").outputs
    splats = add(tree, "GeometryNodeObjectInfo", {"Object": group["Splats"]}, transform_space="ORIGINAL")
    # What the modifiers leave of a splat is a quad: a point in the middle of each is where the splat was.
    centres = out(add(tree, "GeometryNodeMeshToPoints", {"Mesh": splats.outputs["Geometry"]}, mode="FACES"))
    position = out(add(tree, "GeometryNodeInputPosition"))
    nearest = add(tree, "GeometryNodeSampleNearest", {"Geometry": centres, "Sample Position": position})
    stored = group["Geometry"]
    for name in (COLOR, SURFACE, AMOUNT):
        sample = {"Geometry": centres, "Value": _attribute(tree, name, "FLOAT_VECTOR"), "Index": out(nearest)}
        value = add(tree, "GeometryNodeSampleIndex", sample, data_type="FLOAT_VECTOR")
        store = {"Geometry": stored, "Name": name, "Value": out(value)}
        stored = out(add(tree, "GeometryNodeStoreNamedAttribute", store, data_type="FLOAT_VECTOR"))
    add(tree, "NodeGroupOutput", {"Geometry": stored})
    return tree


def show_edits(material: bpy.types.Material) -> None:
    """Have a mesh's material show what edits make of its textures; once."""
    nodes = material.node_tree.nodes
    principled = next((node for node in nodes if node.type == "BSDF_PRINCIPLED"), None)
    if principled is None or _MIXED in nodes:
        return
    tree = material.node_tree

    def attribute(name: str) -> bpy.types.NodeSocket:
        return add(tree, "ShaderNodeAttribute", attribute_name=name).outputs["Vector"]

    amounts = add(tree, "ShaderNodeSeparateXYZ", {0: attribute(AMOUNT)}, name=_MIXED).outputs
    surface = add(tree, "ShaderNodeSeparateXYZ", {0: attribute(SURFACE)}).outputs
    for key, amount, added in (
        ("Base Color", amounts[0], attribute(COLOR)),
        ("Metallic", amounts[1], surface[0]),
        ("Roughness", amounts[2], surface[1]),
    ):
        socket = principled.inputs[key]
        learned = socket.links[0].from_socket if socket.links else socket.default_value
        kept = math(tree, "SUBTRACT", 1.0, amount)
        if key == "Base Color":
            learned = learned if socket.links else tuple(learned)[:3]
            scaled = out(add(tree, "ShaderNodeVectorMath", {0: learned, "Scale": kept}, operation="SCALE"))
            result = out(add(tree, "ShaderNodeVectorMath", {0: scaled, 1: added}, operation="ADD"))
        else:
            result = out(add(tree, "ShaderNodeMath", {0: learned, 1: kept, 2: added}, operation="MULTIPLY_ADD"))
        tree.links.new(result, socket)


def _attribute(tree: bpy.types.NodeTree, name: str, kind: str) -> bpy.types.NodeSocket:
    return out(add(tree, "GeometryNodeInputNamedAttribute", {"Name": name}, data_type=kind))
