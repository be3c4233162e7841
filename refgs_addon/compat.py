"""Hide the differences between Blender 4.3, 4.5 LTS, 5.2 LTS and 5.3 behind functions. No other module checks Blender's version."""

import bpy

EEVEE = "BLENDER_EEVEE" if bpy.app.version >= (5, 0, 0) else "BLENDER_EEVEE_NEXT"

# How Eevee weakens the directional part of the world's diffuse light: see `nodes.world_diffuse`.
EEVEE_WINDOW_BY_LENGTH = bpy.app.version >= (5, 1, 0)

# From 5.3 Blender draws point clouds as Gaussian splats.
DRAWS_SPLATS = "type" in bpy.types.PointCloud.bl_rna.properties

# Image settings of a file format, in the order to set them; from 5.0 a format belongs to a medium.
FORMAT = (["media_type"] if bpy.app.version >= (5, 0, 0) else []) + ["file_format", "color_mode", "color_depth"]

# Options of a property whose path may be relative to the .blend (`//`). Blender 4.5 warns without.
BLEND_RELATIVE = {"ANIMATABLE", "PATH_SUPPORTS_BLEND_RELATIVE"} if bpy.app.version >= (4, 5, 0) else {"ANIMATABLE"}

# Lines for the artist where an exporter of Blender's is missing.
NO_USD = "this Blender was built without USD: use the one from blender.org, or export FBX"
NO_FBX = "Blender's FBX add-on is off: enable it in the preferences"


def set_format(settings: bpy.types.ImageFormatSettings, kind: str, depth: str) -> None:
    """Set the format of saved RGBA pictures: "PNG" or "OPEN_EXR", with `depth` bits per channel."""
    for name, value in zip(FORMAT, ["IMAGE"] * (len(FORMAT) - 3) + [kind, "RGBA", depth], strict=True):
        setattr(settings, name, value)


def new_point_cloud(name: str, count: int) -> bpy.types.PointCloud:
    """Make a point cloud of `count` points at the origin."""
    if "resize" in bpy.types.PointCloud.bl_rna.functions:  # from 5.1; hasattr is always False
        cloud = bpy.data.pointclouds.new(name)
        cloud.resize(count)
        return cloud
    # Before 5.1 only geometry nodes make a cloud of a given size; a copy of their result is real data.
    tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    points, output = tree.nodes.new("GeometryNodePoints"), tree.nodes.new("NodeGroupOutput")
    points.inputs["Count"].default_value = count
    tree.links.new(points.outputs[0], output.inputs[0])
    empty = bpy.data.pointclouds.new(name)
    maker = bpy.data.objects.new(name, empty)
    maker.modifiers.new(name, "NODES").node_group = tree
    bpy.context.scene.collection.objects.link(maker)
    cloud = maker.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.copy()
    bpy.data.batch_remove([maker, empty, tree])
    cloud.name = name
    return cloud


def node_tree(data: bpy.types.Material | bpy.types.World) -> bpy.types.NodeTree:
    """Empty the node tree of a material or a world, and return it."""
    if data.node_tree is None:  # from 5.0 a tree always exists, and `use_nodes` is deprecated
        data.use_nodes = True
    data.node_tree.nodes.clear()
    return data.node_tree


def modifier_input(modifier: bpy.types.NodesModifier, name: str) -> tuple[bpy.types.bpy_struct, str]:
    """Return the data and property name that `layout.prop` needs to draw a modifier's input."""
    identifier = modifier.node_group.interface.items_tree[name].identifier
    if hasattr(modifier, "properties"):  # from 5.2
        return getattr(modifier.properties.inputs, identifier), "value"
    return modifier, f'["{identifier}"]'


def set_modifier_input(modifier: bpy.types.NodesModifier, name: str, value) -> None:
    """Set a modifier's input by its name. For a menu, `value` is the item's name."""
    owner, path = modifier_input(modifier, name)
    if path == "value":
        owner.value = value
    else:
        key = path[2:-2]
        if modifier.node_group.interface.items_tree[name].socket_type == "NodeSocketMenu":
            # Before 5.2 a menu is stored as its item's number.
            items = modifier.id_properties_ui(key).as_dict()["items"]
            value = next(item[4] for item in items if item[0] == value)
        owner[key] = value
    if isinstance(value, bpy.types.ID):
        modifier.node_group = modifier.node_group  # or Blender does not evaluate the modifier when `value` changes
    modifier.id_data.update_tag()


def get_modifier_input(modifier: bpy.types.NodesModifier, name: str):
    """Return the value of a modifier's input; for a menu, the chosen item's name."""
    owner, path = modifier_input(modifier, name)
    if path == "value":
        return owner.value
    key = path[2:-2]
    value = owner.get(key)
    if modifier.node_group.interface.items_tree[name].socket_type == "NodeSocketMenu":
        items = modifier.id_properties_ui(key).as_dict()["items"]
        return next((item[0] for item in items if item[4] == value), "")
    return value


def paint_colors(settings: bpy.types.ToolSettings) -> bpy.types.UnifiedPaintSettings:
    """Return the settings that hold the colours of the brushes that paint on images."""
    return getattr(settings.image_paint, "unified_paint_settings", None) or settings.unified_paint_settings  # from 5.0


def fcurves(item: bpy.types.Object) -> list[bpy.types.FCurve]:
    """List the animation curves of an object. The object must be animated."""
    animation = item.animation_data
    if hasattr(animation.action, "fcurves"):  # until 5.0
        return list(animation.action.fcurves)
    strips = [strip for layer in animation.action.layers for strip in layer.strips]
    return [curve for strip in strips for curve in strip.channelbag(animation.action_slot).fcurves]


def has_operator(operator) -> bool:
    """Check whether an operator of `bpy.ops` exists. Blender may be built without it, or its add-on may be off."""
    try:
        operator.get_rna_type()
    except KeyError:
        return False
    return True


def usd_materials() -> dict[str, str | bool]:
    """Return arguments for Blender's USD exporter. With them, it writes MaterialX beside UsdPreviewSurface, and copies no textures.

    The USD file refers to the existing texture files.

    Raises KeyError if Blender was built without USD, as Debian's Blender is.
    """
    known = bpy.ops.wm.usd_export.get_rna_type().properties
    textures = {"export_textures_mode": "KEEP"} if "export_textures_mode" in known else {"export_textures": False}
    return textures | {"generate_materialx_network": True}
