"""Build the geometry-nodes tree that hides deleted splats. The artist deletes a splat by deleting its vertex from a mesh of points."""

import bpy

from . import add, add_input, math, modifier_tree, out, store_attribute

NAME = "RefGS Kept"  # the tree and its modifier
ROW = "row"  # attribute of the splats that are left: where each was among all splats
OPENED = "opened"  # attribute of the splats that are left: 1 if others were deleted, and the inside can be seen
_SAME = 1e-6  # farthest that a splat is from its own point, which is a copy of its position


def kept_tree() -> bpy.types.NodeTree:
    """Make the node tree `RefGS Kept`, or return the existing one, which all runs share.

    The tree keeps a splat if the mesh of the object Points has a vertex at the splat's position, in the objects' local coordinates. It
    keeps all splats if that mesh is missing or empty.
    """
    if NAME in bpy.data.node_groups:
        return bpy.data.node_groups[NAME]
    tree = modifier_tree(NAME)
    add_input(tree, "Points", "Object", "Mesh with a vertex for each splat that is kept")
    group = add(tree, "NodeGroupInput").outputs
    points = add(tree, "GeometryNodeObjectInfo", {"Object": group["Points"]}, transform_space="ORIGINAL")
    position = out(add(tree, "GeometryNodeInputPosition"))
    near = {"Geometry": points.outputs["Geometry"], "Sample Position": position}
    distance = add(tree, "GeometryNodeProximity", near, target_element="POINTS").outputs["Distance"]
    index = out(add(tree, "GeometryNodeInputIndex"))
    stored = store_attribute(tree, group["Geometry"], ROW, "INT", index)
    gone = math(tree, "GREATER_THAN", distance, _SAME)
    kept = out(add(tree, "GeometryNodeDeleteGeometry", {"Geometry": stored, "Selection": gone}))
    before, after = (
        add(tree, "GeometryNodeAttributeDomainSize", {"Geometry": cloud}, component="POINTCLOUD").outputs["Point Count"]
        for cloud in (group["Geometry"], kept)
    )
    opened = store_attribute(tree, kept, OPENED, "FLOAT", math(tree, "GREATER_THAN", before, after))
    add(tree, "NodeGroupOutput", {"Geometry": opened})
    return tree
