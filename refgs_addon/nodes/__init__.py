"""Build node trees in Python, one module for each tree."""

import bpy


def modifier_tree(name: str) -> bpy.types.NodeTree:
    """Make a geometry-nodes tree for a modifier, with one input and one output for geometry."""
    tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
    tree.is_modifier = True
    for in_out in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=in_out, socket_type="NodeSocketGeometry")
    return tree


def add(tree: bpy.types.NodeTree, kind: str, inputs: dict | None = None, **properties) -> bpy.types.Node:
    """Add a node of the Blender type `kind`, such as "ShaderNodeMath", and return it.

    `inputs` maps an input socket (its name or index) to a value, or to another node's output, which is linked to it. `properties` are set
    on the node.
    """
    node = tree.nodes.new(kind)
    for name, value in properties.items():
        setattr(node, name, value)
    for key, value in (inputs or {}).items():
        # Nodes of many data types have a socket of the same name for each, and enable the one in use.
        socket = (
            node.inputs[key] if isinstance(key, int) else next(s for s in node.inputs if s.name == key and s.enabled)
        )
        if isinstance(value, bpy.types.NodeSocket):
            tree.links.new(value, socket)
        else:
            socket.default_value = value
    return node


def add_input(tree: bpy.types.NodeTree, name: str, kind: str, description: str = "", **properties):
    """Add and return an input socket of a `kind` such as "Float", with these `properties`."""
    socket = tree.interface.new_socket(name, in_out="INPUT", socket_type=f"NodeSocket{kind}", description=description)
    for key, value in properties.items():
        setattr(socket, key, value)
    return socket


def out(node: bpy.types.Node, name: str | None = None) -> bpy.types.NodeSocket:
    """Find the enabled output with this name. Without a name, return the first enabled output."""
    return next(s for s in node.outputs if s.enabled and name in (None, s.name))


def principled(material: bpy.types.Material) -> bpy.types.ShaderNode:
    """Find a material's first Principled BSDF."""
    return next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")


def math(tree: bpy.types.NodeTree, operation: str, *inputs) -> bpy.types.NodeSocket:
    """Add a math node whose inputs are sockets or numbers, and return its output."""
    return out(add(tree, "ShaderNodeMath", dict(enumerate(inputs)), operation=operation))


def vector_math(tree: bpy.types.NodeTree, operation: str, *inputs) -> bpy.types.NodeSocket:
    """Add a vector math node whose inputs are sockets or vectors, and return its output."""
    return out(add(tree, "ShaderNodeVectorMath", dict(enumerate(inputs)), operation=operation))


def scaled(tree: bpy.types.NodeTree, vector, factor) -> bpy.types.NodeSocket:
    """Add a node that multiplies a vector by a factor; return its output."""
    return out(add(tree, "ShaderNodeVectorMath", {"Vector": vector, "Scale": factor}, operation="SCALE"))


def read_attribute(tree: bpy.types.NodeTree, name: str, kind: str) -> bpy.types.NodeSocket:
    """Add a node that reads a geometry attribute of the type `kind`, such as "FLOAT"."""
    return out(add(tree, "GeometryNodeInputNamedAttribute", {"Name": name}, data_type=kind))


def store_attribute(tree: bpy.types.NodeTree, geometry, name: str, kind: str, value) -> bpy.types.NodeSocket:
    """Add a node that stores `value` as the attribute `name` of a geometry, and return its output: the geometry with that attribute.

    `kind` is the attribute's data type, such as "FLOAT".
    """
    inputs = {"Geometry": geometry, "Name": name, "Value": value}
    return out(add(tree, "GeometryNodeStoreNamedAttribute", inputs, data_type=kind))


def object_frame(tree: bpy.types.NodeTree, item: bpy.types.NodeSocket) -> tuple[bpy.types.Node, bpy.types.NodeSocket]:
    """Add nodes that compute each point's position in the local coordinates of another object. `item` is a socket with that object.

    Returns the Object Info node of that object, and the output with the positions.
    """
    info = add(tree, "GeometryNodeObjectInfo", {"Object": item}, transform_space="RELATIVE")
    inverse = add(tree, "FunctionNodeInvertMatrix", {"Matrix": info.outputs["Transform"]}).outputs["Matrix"]
    position = out(add(tree, "GeometryNodeInputPosition"))
    return info, out(add(tree, "FunctionNodeTransformPoint", {"Vector": position, "Transform": inverse}))


def max_component(tree: bpy.types.NodeTree, vector: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Add nodes that compute max(|x|, |y|, |z|) of a vector, and return their output."""
    x, y, z = add(tree, "ShaderNodeSeparateXYZ", {0: vector_math(tree, "ABSOLUTE", vector)}).outputs
    return math(tree, "MAXIMUM", math(tree, "MAXIMUM", x, y), z)
