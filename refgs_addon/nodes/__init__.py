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
    """Add a node. `inputs` maps the name or index of a socket to another node's output or to a value."""
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
    """Add an input socket of a type ("Float", "Object" …) to a tree, and return it."""
    socket = tree.interface.new_socket(name, in_out="INPUT", socket_type=f"NodeSocket{kind}", description=description)
    for key, value in properties.items():
        setattr(socket, key, value)
    return socket


def out(node: bpy.types.Node, name: str | None = None) -> bpy.types.NodeSocket:
    """Find the enabled output with this name. Without a name, return the first enabled output."""
    return next(s for s in node.outputs if s.enabled and name in (None, s.name))


def math(tree: bpy.types.NodeTree, operation: str, *inputs) -> bpy.types.NodeSocket:
    """Add a math node and return its output. Each of `inputs` is a socket or a number."""
    return out(add(tree, "ShaderNodeMath", dict(enumerate(inputs)), operation=operation))


def vector_math(tree: bpy.types.NodeTree, operation: str, *inputs) -> bpy.types.NodeSocket:
    """Add a vector math node for sockets and vectors; return its output."""
    return out(add(tree, "ShaderNodeVectorMath", dict(enumerate(inputs)), operation=operation))


def scaled(tree: bpy.types.NodeTree, vector, factor) -> bpy.types.NodeSocket:
    """Add a node that multiplies a vector by a factor; return its output."""
    return out(add(tree, "ShaderNodeVectorMath", {"Vector": vector, "Scale": factor}, operation="SCALE"))


def read_attribute(tree: bpy.types.NodeTree, name: str, kind: str) -> bpy.types.NodeSocket:
    """Add a node that reads a named attribute of the geometry; return its output."""
    return out(add(tree, "GeometryNodeInputNamedAttribute", {"Name": name}, data_type=kind))


def store_attribute(tree: bpy.types.NodeTree, geometry, name: str, kind: str, value) -> bpy.types.NodeSocket:
    """Add a node that stores a named attribute of the geometry; return the geometry."""
    inputs = {"Geometry": geometry, "Name": name, "Value": value}
    return out(add(tree, "GeometryNodeStoreNamedAttribute", inputs, data_type=kind))


def object_frame(tree: bpy.types.NodeTree, item: bpy.types.NodeSocket) -> tuple[bpy.types.Node, bpy.types.NodeSocket]:
    """Add nodes that transform the points' positions into the frame of the object `item`.

    Returns the object's Object Info node, and the output with the positions.
    """
    info = add(tree, "GeometryNodeObjectInfo", {"Object": item}, transform_space="RELATIVE")
    inverse = add(tree, "FunctionNodeInvertMatrix", {"Matrix": info.outputs["Transform"]}).outputs["Matrix"]
    position = out(add(tree, "GeometryNodeInputPosition"))
    return info, out(add(tree, "FunctionNodeTransformPoint", {"Vector": position, "Transform": inverse}))


def max_component(tree: bpy.types.NodeTree, vector: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Add nodes that compute a vector's largest absolute component, which is at most 1 in the cube from -1 to 1. Returns their output."""
    x, y, z = add(tree, "ShaderNodeSeparateXYZ", {0: vector_math(tree, "ABSOLUTE", vector)}).outputs
    return math(tree, "MAXIMUM", math(tree, "MAXIMUM", x, y), z)
