"""Node trees, built in Python: one module a tree."""

import bpy


def modifier_tree(name: str) -> bpy.types.NodeTree:
    """A new geometry-nodes tree for a modifier, with nothing but its geometry in and out."""
    tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
    tree.is_modifier = True
    for way in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    return tree


def add(tree: bpy.types.NodeTree, kind: str, inputs: dict | None = None, **properties) -> bpy.types.Node:
    """Add a node. `inputs` maps a socket's name or index to what feeds it: another node's output, or a value."""
    node = tree.nodes.new(kind)
    for name, value in properties.items():
        setattr(node, name, value)
    for key, value in (inputs or {}).items():
        # Nodes of many types keep one socket a type under the same name, and enable the one in use.
        socket = (
            node.inputs[key] if isinstance(key, int) else next(s for s in node.inputs if s.name == key and s.enabled)
        )
        if isinstance(value, bpy.types.NodeSocket):
            tree.links.new(value, socket)
        else:
            socket.default_value = value
    return node


def out(node: bpy.types.Node, name: str | None = None) -> bpy.types.NodeSocket:
    """The output of this name that is in use; the first in use without a name."""
    return next(s for s in node.outputs if s.enabled and name in (None, s.name))


def math(tree: bpy.types.NodeTree, operation: str, *inputs) -> bpy.types.NodeSocket:
    """What a node of arithmetic makes of sockets and numbers."""
    return out(add(tree, "ShaderNodeMath", dict(enumerate(inputs)), operation=operation))


def seen_from(tree: bpy.types.NodeTree, item: bpy.types.NodeSocket) -> tuple[bpy.types.Node, bpy.types.NodeSocket]:
    """The Object Info of an object, and where points are in its own frame."""
    info = add(tree, "GeometryNodeObjectInfo", {"Object": item}, transform_space="RELATIVE")
    inverse = add(tree, "FunctionNodeInvertMatrix", {"Matrix": info.outputs["Transform"]}).outputs["Matrix"]
    position = out(add(tree, "GeometryNodeInputPosition"))
    return info, out(add(tree, "FunctionNodeTransformPoint", {"Vector": position, "Transform": inverse}))


def largest(tree: bpy.types.NodeTree, vector: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """The largest of a vector's absolute components: at most 1 in a cube of radius 1."""
    absolute = out(add(tree, "ShaderNodeVectorMath", {0: vector}, operation="ABSOLUTE"))
    x, y, z = add(tree, "ShaderNodeSeparateXYZ", {0: absolute}).outputs
    return math(tree, "MAXIMUM", math(tree, "MAXIMUM", x, y), z)
