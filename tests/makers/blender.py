"""Read data from Blender: attributes, the mesh that a modifier makes, and a material's shader node."""

import bpy
import numpy as np

FIELDS = {"FLOAT": ("value", 1), "FLOAT_VECTOR": ("vector", 3), "FLOAT_COLOR": ("color", 4), "QUATERNION": ("value", 4)}


def attribute(data, name):
    """Read a named attribute of a mesh or a point cloud: (N,) float32, or (N, width) for vectors, colours and quaternions."""
    found = data.attributes[name]
    field, width = FIELDS[found.data_type]
    values = np.empty((len(found.data), width), np.float32)
    found.data.foreach_get(field, values.ravel())
    return values if width > 1 else values[:, 0]


def evaluated_mesh(item):
    """Evaluate the modifier that turns an object's point cloud into quads, and return the mesh."""
    graph = bpy.context.evaluated_depsgraph_get()
    graph.update()
    return next(i.object.data for i in graph.object_instances if i.object.original == item and i.object.type == "MESH")


def principled(material):
    """Return the Principled BSDF node of a material."""
    return next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
