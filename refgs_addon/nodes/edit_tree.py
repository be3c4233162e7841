"""Build the two node trees for edits. An edit is a modifier on the splats that changes their materials.

`edit_tree` is the edit itself. `mesh_edits_tree` copies the changes from the splats to the mesh. Neither overwrites the materials learned
from the photos.
"""

import bpy

from ..scene.color_spaces import from_rec709
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
from .world_diffuse import surface_inputs

NAME = "RefGS Edit"
MESH_EDITS = "RefGS Follow"  # the mesh's tree and modifier
FALLOFF = 0.2  # of a new edit: the width of its soft border, as a fraction of the region
REGIONS = ("Everywhere", "Box", "Sphere", "Similar", "Painted")
# Result of the edits so far at a point, as premultiplied values and alpha: COLOR and SURFACE (metallic, roughness) are multiplied by
# AMOUNT (of colour, metallic, roughness).
COLOR, SURFACE, AMOUNT = "edit_color", "edit_surface", "edit_amount"
_MIXED = "RefGS Edited"  # node that marks a mesh's material as showing the edits


def edit_tree() -> bpy.types.NodeTree:
    """Make the node tree `RefGS Edit`, or return the existing one. All edits (modifiers that change the splats' materials) share it.

    The tree blends each splat's base_color, metallic and roughness with new values. The weight of a new value is amount · mask. The amount
    is an input of the tree, one for each of the three values. The mask is 0..1 for each splat. The input Where selects the mask:
    - "Everywhere": 1 for all splats;
    - "Box" or "Sphere": 1 inside the object Region, an Empty, and 0 outside. Falloff is the width of the soft border, as a fraction of the
      region;
    - "Similar": 1 if the splat's material equals that of the splat nearest to Region, 0 if it differs by more than Tolerance;
    - "Painted": the weight that is painted on the mesh Region, at the point nearest to the splat. Painted is the name of its vertex group.
    """
    if NAME in bpy.data.node_groups:
        return bpy.data.node_groups[NAME]
    tree = modifier_tree(NAME)
    which = (
        "all, those in a box or a ball, those with a material like the one at the region, or those painted on a mesh"
    )
    add_input(tree, "Where", "Menu", f"Which splats to edit: {which}")
    add_input(tree, "Region", "Object", "Object that marks the region: move, rotate and scale it")
    add_input(tree, "Painted", "String", "Painted vertex group of the region")
    add_input(tree, "Base Color", "Color", "New base colour", default_value=from_rec709((1.0, 0.77, 0.34, 1.0)))
    for name, value, description in (
        ("Falloff", FALLOFF, "Width of the soft border, as a fraction of the region"),
        ("Tolerance", 0.2, "Largest difference from the material at the region that is still edited"),
        ("Color Amount", 1.0, "Amount of the base colour to replace"),
        ("Metallic", 1.0, "New metallic"),
        ("Metallic Amount", 1.0, "Amount of the metallic to replace"),
        ("Roughness", 0.2, "New roughness"),
        ("Roughness Amount", 1.0, "Amount of the roughness to replace"),
    ):
        limits = {"min_value": 0.0, "max_value": 1.0, "subtype": "FACTOR"}
        add_input(tree, name, "Float", description, default_value=value, **limits)

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
    # Read all values before writing any: the "Similar" mask compares the unedited materials.
    values = {}
    for name, kind, mix, factor, value in changed:
        mixed = {"Factor": factor, "A": read_attribute(tree, name, kind), "B": value}
        by = "NON_UNIFORM" if mix == "VECTOR" else "UNIFORM"
        values[name] = kind, out(add(tree, "ShaderNodeMix", mixed, data_type=mix, factor_mode=by))
    geometry = add(tree, "GeometryNodeCaptureAttribute", {"Geometry": group["Geometry"]}, domain="POINT")
    for name, (kind, _) in values.items():
        geometry.capture_items.new({"FLOAT_COLOR": "RGBA", "FLOAT_VECTOR": "VECTOR", "FLOAT": "FLOAT"}[kind], name)
    stored = geometry.outputs["Geometry"]
    for name, (_, value) in values.items():
        tree.links.new(value, geometry.inputs[name])
    for name, (kind, _) in values.items():
        stored = store_attribute(tree, stored, name, kind, geometry.outputs[name])
    add(tree, "NodeGroupOutput", {"Geometry": stored})
    return tree


def _mask(tree: bpy.types.NodeTree, group: bpy.types.NodeOutputs) -> bpy.types.NodeSocket:
    """Add the nodes for the mask that `edit_tree` describes, 0..1 for each splat."""
    menu = add(tree, "GeometryNodeMenuSwitch", data_type="FLOAT")
    menu.enum_items.clear()
    for name in REGIONS:
        menu.enum_items.new(name)
    tree.links.new(group["Where"], menu.inputs["Menu"])
    region, inside = object_frame(tree, group["Region"])
    box = max_component(tree, inside)
    ball = vector_math(tree, "LENGTH", inside)
    where = {"Geometry": group["Geometry"], "Sample Position": region.outputs["Location"]}
    nearest = add(tree, "GeometryNodeSampleNearest", where)
    squares = []  # of distances in the working space: in ACEScg, hues differ less than in linear Rec.709
    for name, kind in (("base_color", "FLOAT_VECTOR"), ("metallic", "FLOAT"), ("roughness", "FLOAT")):
        value = read_attribute(tree, name, kind)
        sample = {"Geometry": group["Geometry"], "Value": value, "Index": out(nearest)}
        there = add(tree, "GeometryNodeSampleIndex", sample, data_type=kind)
        if kind == "FLOAT":
            squares.append(math(tree, "POWER", math(tree, "SUBTRACT", value, out(there)), 2.0))
        else:
            difference = vector_math(tree, "SUBTRACT", value, out(there))
            squares.append(vector_math(tree, "DOT_PRODUCT", difference, difference))
    unlike = math(tree, "SQRT", math(tree, "ADD", math(tree, "ADD", *squares[:2]), squares[2]))
    unlike = math(tree, "DIVIDE", unlike, math(tree, "MAXIMUM", group["Tolerance"], 1e-6))
    position = out(add(tree, "GeometryNodeInputPosition"))
    weight = {"Mesh": region.outputs["Geometry"], "Sample Position": position}
    weight["Value"] = read_attribute(tree, group["Painted"], "FLOAT")
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


def mesh_edits_tree() -> bpy.types.NodeTree:
    """Make the node tree `RefGS Follow`, or return the existing one. It makes a mesh show the edits of the splats' materials.

    Each vertex gets the edits of the splat nearest to it. Distances are between their positions in local coordinates. So the two objects
    need not stand in the same place.
    """
    if MESH_EDITS in bpy.data.node_groups:
        return bpy.data.node_groups[MESH_EDITS]
    tree = modifier_tree(MESH_EDITS)
    add_input(tree, "Splats", "Object")
    group = add(tree, "NodeGroupInput").outputs
    splats = add(tree, "GeometryNodeObjectInfo", {"Object": group["Splats"]}, transform_space="ORIGINAL")
    # Splats are drawn as points, or as quads in a mesh; a quad's centre is the splat's position.
    parts = add(tree, "GeometryNodeSeparateComponents", {"Geometry": splats.outputs["Geometry"]}).outputs
    quads = out(add(tree, "GeometryNodeMeshToPoints", {"Mesh": parts["Mesh"]}, mode="FACES"))
    joined = add(tree, "GeometryNodeJoinGeometry", {"Geometry": quads})
    tree.links.new(parts["Point Cloud"], joined.inputs["Geometry"])
    centres = out(joined)
    position = out(add(tree, "GeometryNodeInputPosition"))
    nearest = add(tree, "GeometryNodeSampleNearest", {"Geometry": centres, "Sample Position": position})
    stored = group["Geometry"]
    for name in (COLOR, SURFACE, AMOUNT):
        sample = {"Geometry": centres, "Value": read_attribute(tree, name, "FLOAT_VECTOR"), "Index": out(nearest)}
        value = out(add(tree, "GeometryNodeSampleIndex", sample, data_type="FLOAT_VECTOR"))
        stored = store_attribute(tree, stored, name, "FLOAT_VECTOR", value)
    add(tree, "NodeGroupOutput", {"Geometry": stored})
    return tree


def add_edits_to_material(material: bpy.types.Material) -> None:
    """Make a mesh's material blend the edited base colour, metallic and roughness over its textures."""
    tree = material.node_tree
    if _MIXED in tree.nodes or not any(node.type == "BSDF_PRINCIPLED" for node in tree.nodes):
        return
    sockets = surface_inputs(material)

    def attribute(name: str) -> bpy.types.NodeSocket:
        return add(tree, "ShaderNodeAttribute", attribute_name=name).outputs["Vector"]

    amounts = add(tree, "ShaderNodeSeparateXYZ", {0: attribute(AMOUNT)}, name=_MIXED).outputs
    surface = add(tree, "ShaderNodeSeparateXYZ", {0: attribute(SURFACE)}).outputs
    for key, amount, added in (
        ("Base Color", amounts[0], attribute(COLOR)),
        ("Metallic", amounts[1], surface[0]),
        ("Roughness", amounts[2], surface[1]),
    ):
        socket = sockets[key][0]
        learned = socket.links[0].from_socket if socket.links else socket.default_value
        kept = math(tree, "SUBTRACT", 1.0, amount)
        if key == "Base Color":
            learned = learned if socket.links else tuple(learned)[:3]
            result = vector_math(tree, "ADD", scaled(tree, learned, kept), added)
        else:
            result = out(add(tree, "ShaderNodeMath", {0: learned, 1: kept, 2: added}, operation="MULTIPLY_ADD"))
        for socket in sockets[key]:
            tree.links.new(result, socket)
