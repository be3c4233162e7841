"""Read data from Blender: attributes, the splats that a modifier draws, and a material's shader node."""

import bpy
import numpy as np

from refgs_addon.compat import DRAWS_SPLATS
from refgs_addon.nodes.splats_tree import EXTENT

FIELDS = {"FLOAT": ("value", 1), "FLOAT_VECTOR": ("vector", 3), "FLOAT4": ("vector", 4)}
FIELDS |= {"FLOAT_COLOR": ("color", 4), "QUATERNION": ("value", 4)}


def attribute(data, name):
    """Read a named attribute of a mesh or a point cloud: (N,) float32, or (N, width) for vectors, colours and quaternions."""
    found = data.attributes[name]
    field, width = FIELDS[found.data_type]
    values = np.empty((len(found.data), width), np.float32)
    found.data.foreach_get(field, values.ravel())
    return values if width > 1 else values[:, 0]


def drawn_splats(item):
    """Evaluate the modifier that draws an object's points, and return what it draws: splats from Blender 5.3, quads in a mesh before."""
    graph, kind = bpy.context.evaluated_depsgraph_get(), "POINTCLOUD" if DRAWS_SPLATS else "MESH"
    graph.update()
    data = next(i.object.data for i in graph.object_instances if i.object.original == item and i.object.type == kind)
    assert not DRAWS_SPLATS or data.type == "GAUSSIAN_SPLAT"
    return data


def drawn(item, name):
    """Read an attribute of the splats that are drawn, one value a splat."""
    return attribute(drawn_splats(item), name)[:: 1 if DRAWS_SPLATS else 4]


def drawn_material(item):
    """Return the name of the material that the splats are drawn with."""
    data = drawn_splats(item)
    return data.materials[0 if DRAWS_SPLATS else data.polygons[0].material_index].name


def drawn_axes(item):
    """Return the centres (N, 3) of the splats that are drawn, and their two axes (N, 2, 3), a standard deviation long."""
    data = drawn_splats(item)
    if DRAWS_SPLATS:
        w, x, y, z = attribute(data, "rotation").T
        u = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
        v = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=1)
        return attribute(data, "position"), np.stack([u, v], axis=1) * attribute(data, "scale")[:, :2, None]
    corners = attribute(data, "position").reshape(-1, 4, 3)
    sides = {tuple(place): number for number, place in enumerate(attribute(data, "gaussian")[:4, :2].tolist())}
    first, u, v = (sides[place] for place in ((-EXTENT, -EXTENT), (EXTENT, -EXTENT), (-EXTENT, EXTENT)))
    return corners.mean(axis=1), (corners[:, [u, v]] - corners[:, [first]]) / (2 * EXTENT)


def principled(material):
    """Return the Principled BSDF node of a material."""
    return next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
