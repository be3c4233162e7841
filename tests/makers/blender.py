"""Read data from Blender: attributes, the splats that a modifier draws, and a material's shader node."""

import bpy
import numpy as np
from mathutils import Vector

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


def brightness_from_above(run, scene, folder):
    """Render an imported run from above, under a white light. Returns the green of its middle, linear."""
    run.root.location = (0, 0, 0)
    scene.world = bpy.data.worlds.new("white")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (1, 1, 1, 1)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    bpy.context.view_layer.update()
    middle = sum((run.splats.matrix_world @ Vector(corner) for corner in run.splats.bound_box), Vector()) / 8
    camera.location, scene.camera = middle + Vector((0, 0, 3)), camera
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 16, False
    scene.render.resolution_x = scene.render.resolution_y = 8
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.filepath = str(folder / "a.exr")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    return np.array(image.pixels[:]).reshape(8, 8, 4)[3:5, 3:5, 1].mean()
