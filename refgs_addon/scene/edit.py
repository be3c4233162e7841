"""Edit the splats' materials. Each edit is a modifier, which the artist can change, switch off, move or remove at any time."""

import contextlib
from collections.abc import Iterator

import bpy
from mathutils import Vector

from .. import compat
from ..errors import InputError
from ..nodes.edit_tree import FALLOFF, MESH_EDITS, NAME, REGIONS, add_edits_to_material, edit_tree, mesh_edits_tree
from ..nodes.splat_material import connect_edits
from ..nodes.splats_tree import NAME as SPLATS
from .deleted_splats import count_deleted
from .material_presets import read_material, set_inputs
from .regions import REGION, add_region, bounds
from .run_parts import parts, stand_with

FIRST = 0.1  # of the splats, that a new box or ball changes fully
SOLID = 0.5  # opacity of splats that count as the surface


def add_edit(
    collection: bpy.types.Collection, where: str = "Everywhere", material: str = "Gold"
) -> bpy.types.NodesModifier:
    """Add an edit after the earlier edits of a run. An edit is a modifier that changes the splats' materials. The mesh shows the edit too.

    `collection` is the collection of the run. `where` selects the splats, as in `nodes.edit_tree`: "Everywhere", "Box", "Sphere", "Similar"
    or "Painted". "Box", "Sphere" and "Similar" get an Empty, which the artist moves, rotates and scales.
    "Painted" gets an object with the shape of the mesh, on which the artist paints. `material` is the name of a material preset.
    The edit is named after both, such as "Gold, box".

    Raises InputError if the collection has no splats, or if the preset is missing or invalid. "Painted" also needs a mesh.
    """
    if where not in REGIONS:
        raise InputError(f"there is no region {where}: choose one of {', '.join(REGIONS)}")
    values = read_material(material)
    splats = splats_of(collection)
    if where == "Painted" and not parts(collection).get("mesh"):
        raise InputError(f"{collection.name} has no mesh to paint on: make the run's mesh, and import the run again")
    edit = splats.modifiers.new(f"{material}, {where.lower()}", "NODES")
    edit.node_group = edit_tree()
    splats.modifiers.move(len(splats.modifiers) - 1, splats.modifiers.find(SPLATS))
    edit = splats.modifiers[edit.name]
    compat.set_modifier_input(edit, "Where", where)
    if where == "Painted":
        canvas, group = _paint_target(parts(collection)["mesh"][0], collection)
        for name, value in (("Region", canvas), ("Painted", group), ("Falloff", 1.0)):
            compat.set_modifier_input(edit, name, value)
    elif where != "Everywhere":
        compat.set_modifier_input(edit, "Region", _region(splats, collection, where))
    set_inputs(edit, values)
    connect_edits(splats.data.materials[0])
    for mesh in parts(collection).get("mesh", []):
        _show_edits_on_mesh(mesh, splats)
    return edit


def edits(splats: bpy.types.Object) -> list[bpy.types.NodesModifier]:
    """List the splats' edits, modifiers that change their materials, in the order Blender applies them."""
    return [m for m in splats.modifiers if m.type == "NODES" and m.node_group and m.node_group.name == NAME]


def is_edited(splats: bpy.types.Object) -> bool:
    """Check whether the splats' materials are edited, or any splat was deleted."""
    return bool(edits(splats)) or count_deleted(splats) > 0


def remove_edit(splats: bpy.types.Object, name: str) -> None:
    """Remove an edit and the region that only it uses. Raises InputError for unknown edits."""
    edit = splats.modifiers.get(name)
    if edit is None or edit not in edits(splats):
        raise InputError(f"{splats.name} has no edit {name}")
    region = compat.get_modifier_input(edit, "Region")
    splats.modifiers.remove(edit)
    shared = any(compat.get_modifier_input(other, "Region") == region for other in edits(splats))
    if region is not None and region.get(REGION) and not shared:
        bpy.data.objects.remove(region)


def splats_of(collection: bpy.types.Collection) -> bpy.types.Object:
    """Find the splats' object in a run's collection. Raises InputError where there is none."""
    found = parts(collection).get("splats", [])
    if not found or SPLATS not in found[0].modifiers:
        raise InputError(f"{collection.name} has no splats: import a RefGS run")
    return found[0]


@contextlib.contextmanager
def evaluated_splats(splats: bpy.types.Object) -> Iterator[bpy.types.PointCloud]:
    """Yield the splats' points after all edits, without the deleted ones. They are gone after the `with` block."""
    drawing = splats.modifiers[SPLATS]
    before = drawing.show_viewport, splats.hide_viewport, splats.hide_get()
    drawing.show_viewport = splats.hide_viewport = False  # Blender does not evaluate hidden objects
    splats.hide_set(False)
    try:
        bpy.context.view_layer.update()
        yield splats.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    finally:
        drawing.show_viewport, splats.hide_viewport = before[:2]
        splats.hide_set(before[2])


def _region(splats: bpy.types.Object, collection: bpy.types.Collection, where: str) -> bpy.types.Object:
    """Add an Empty that marks where an edit applies.

    A new box or ball reaches from the middle of the splats to the surface, so that it changes something at once. The axes of "Similar"
    stand on the surface.
    """
    shape = {"Box": "CUBE", "Sphere": "SPHERE", "Similar": "ARROWS"}[where]
    region = add_region(splats, collection, f"{where} of {splats.name}", shape)
    side, (low, high) = max(region.scale), bounds(splats.data)
    middle = (low + high) / 2
    apart = [place - middle for place in _solid_places(splats.data)] or [high - middle]
    if where == "Similar":
        region.location = splats.matrix_basis @ (middle + min(apart, key=lambda line: line.length))
        region.scale = [side / 6] * 3
        return region
    reach = sorted(line.length if where == "Sphere" else max(map(abs, line)) for line in apart)
    region.scale = [max(side / 3, reach[int(FIRST * (len(reach) - 1))] / (1 - FALLOFF))] * 3
    return region


def _solid_places(cloud: bpy.types.PointCloud) -> list[Vector]:
    """Return the positions of the splats that are not nearly transparent."""
    places, opacities = [0.0] * (3 * len(cloud.points)), [0.0] * len(cloud.points)
    cloud.attributes["position"].data.foreach_get("vector", places)
    cloud.attributes["opacity"].data.foreach_get("value", opacities)
    rows = zip(zip(*[iter(places)] * 3, strict=True), opacities, strict=True)
    return [Vector(place) for place, opacity in rows if opacity >= SOLID]


def _paint_target(mesh: bpy.types.Object, collection: bpy.types.Collection) -> tuple[bpy.types.Object, str]:
    """Return an object to paint on, and the name of its new vertex group.

    It shares the mesh's data, but has no modifiers: those of the mesh depend on the painted weights, which would make a cycle. It shows the
    weights while the artist paints, and is invisible otherwise: it would cover the edited mesh or splats.
    """
    found = [item for item in collection.objects if item.get(REGION) and item.data == mesh.data]
    if found:
        canvas = found[0]
    else:
        canvas = bpy.data.objects.new(f"{mesh.name} to paint on", mesh.data)
        canvas[REGION] = canvas.hide_render = True
        for ray in ("camera", "diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
            setattr(canvas, f"visible_{ray}", False)
        stand_with(canvas, mesh)
        collection.objects.link(canvas)
    group = canvas.vertex_groups.new(name="RefGS Painted")
    canvas.vertex_groups.active = group
    return canvas, group.name


def _show_edits_on_mesh(mesh: bpy.types.Object, splats: bpy.types.Object) -> None:
    if MESH_EDITS not in mesh.modifiers:
        modifier = mesh.modifiers.new(MESH_EDITS, "NODES")
        modifier.node_group = mesh_edits_tree()
        compat.set_modifier_input(modifier, "Splats", splats)
    for material in mesh.data.materials:
        if material is not None and material.node_tree is not None:
            add_edits_to_material(material)
