"""Test material edits: what they change, where they apply, and that the run's learned values are kept."""

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from refgs_addon import compat
from refgs_addon.errors import InputError
from refgs_addon.nodes.edit_tree import AMOUNT, COLOR, SURFACE
from refgs_addon.scene.edit import add_edit, edits, remove_edit
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.material_presets import set_material
from refgs_addon.scene.regions import crop
from refgs_addon.scene.run_parts import show
from tests.makers import blender
from tests.makers.blender import attribute
from tests.makers.still_life import write_still_life

GOLD = (1.0, 0.766, 0.336), 1.0, 0.15  # base colour, metallic, roughness
CHROME_ROUGHNESS = 0.02


@pytest.fixture
def run(run):
    """Import the run and show its splats, as Blender does not evaluate hidden objects."""
    show(run.collection, "splats")
    return run


def drawn(run, name):
    """Read an attribute of the splats after all edits: one value per splat."""
    return blender.drawn(run.splats, name)


def learned(run, name):
    """Read an attribute of the splats as imported, which edits do not change."""
    return attribute(run.splats.data, name)


def test_everything_becomes_gold_and_nothing_is_lost(run):
    before = learned(run, "metallic"), learned(run, "base_color")
    edit = add_edit(run.collection, material="Gold")
    color, metallic, roughness = GOLD
    assert drawn(run, "metallic") == pytest.approx(metallic) and drawn(run, "roughness") == pytest.approx(roughness)
    np.testing.assert_allclose(drawn(run, "base_color")[:, :3], np.tile(color, (40, 1)), rtol=1e-5)
    np.testing.assert_array_equal(learned(run, "metallic"), before[0])
    np.testing.assert_array_equal(learned(run, "base_color"), before[1])
    edit.show_viewport = False
    np.testing.assert_allclose(drawn(run, "metallic"), before[0])
    edit.show_viewport = True
    remove_edit(run.splats, edit.name)
    np.testing.assert_allclose(drawn(run, "metallic"), before[0])


def test_a_material_that_leaves_the_colour(run):
    add_edit(run.collection, material="Polished")
    np.testing.assert_allclose(drawn(run, "base_color")[:, :3], learned(run, "base_color")[:, :3], atol=1e-6)
    assert drawn(run, "metallic") == pytest.approx(1)


@pytest.mark.parametrize(
    ("where", "size"), [("Box", lambda p: abs(p).max(axis=1)), ("Sphere", lambda p: np.linalg.norm(p, axis=1))]
)
def test_a_region_is_moved_turned_and_scaled(run, where, size):
    edit = add_edit(run.collection, where, "Chrome")
    compat.set_modifier_input(edit, "Falloff", 0.0)
    region = compat.get_modifier_input(edit, "Region")
    region.location, region.rotation_euler, region.scale = (0.3, -0.2, 0.1), (0.4, 0.5, 0.6), (0.9, 1.2, 0.7)
    bpy.context.view_layer.update()
    inverse = np.array(region.matrix_world.inverted())
    inside = size(learned(run, "position") @ inverse[:3, :3].T + inverse[:3, 3]) < 1
    assert 3 < inside.sum() < 37
    expected = np.where(inside, CHROME_ROUGHNESS, learned(run, "roughness"))
    np.testing.assert_allclose(drawn(run, "roughness"), expected, atol=1e-5)
    # Splats and region that move together keep the edit.
    run.splats.location.x, region.location = 5.0, (5.3, -0.2, 0.1)
    np.testing.assert_allclose(drawn(run, "roughness"), expected, atol=1e-5)


@pytest.mark.parametrize("where", ["Box", "Sphere", "Similar"])
def test_a_new_region_is_seen_and_changes_something(scene, tmp_path, where):
    """Check that a new region is drawn in front of the object that it is in, and reaches the surface of a hollow object."""
    run = import_run(write_still_life(tmp_path / "still"), scene)
    show(run.collection, "splats")
    region = compat.get_modifier_input(add_edit(run.collection, where, "Gold"), "Region")
    assert region.show_in_front
    changed = (drawn(run, "metallic") > 0.99).mean()
    assert changed > 0.09 and (where == "Similar" or changed < 0.7)
    if where == "Similar":
        apart = learned(run, "position") - np.array(region.matrix_basis.translation)
        assert np.linalg.norm(apart, axis=1).min() < 1e-5


def test_the_border_is_soft(run):
    edit = add_edit(run.collection, "Sphere", "Chrome")
    compat.set_modifier_input(edit, "Falloff", 0.5)
    region = compat.get_modifier_input(edit, "Region")
    region.location, region.scale = (0, 0, 0), (2, 2, 2)
    distance = np.linalg.norm(learned(run, "position"), axis=1) / 2
    t = np.clip((1 - distance) / 0.5, 0, 1)
    mask = t * t * (3 - 2 * t)
    assert ((mask > 0.1) & (mask < 0.9)).any()
    expected = learned(run, "roughness") * (1 - mask) + CHROME_ROUGHNESS * mask
    np.testing.assert_allclose(drawn(run, "roughness"), expected, atol=2e-3)


def test_what_is_like_the_splat_at_the_region(run):
    edit = add_edit(run.collection, "Similar", "Rubber")
    compat.set_modifier_input(edit, "Falloff", 0.0)
    compat.set_modifier_input(edit, "Tolerance", 0.6)
    compat.get_modifier_input(edit, "Region").location = learned(run, "position")[7]
    of = np.column_stack([learned(run, "base_color")[:, :3], learned(run, "metallic"), learned(run, "roughness")])
    alike = np.linalg.norm(of - of[7], axis=1) < 0.6
    assert 1 < alike.sum() < 39
    np.testing.assert_allclose(drawn(run, "metallic"), np.where(alike, 0, of[:, 3]), atol=1e-5)


def test_the_mesh_follows_all_edits(run):
    """Check that the drawn material is the learned material, blended with all edits.

    Each vertex of the mesh must get the edits of its nearest splat.
    """
    first = add_edit(run.collection, material="Gold")
    compat.set_modifier_input(first, "Color Amount", 0.7)
    second = add_edit(run.collection, "Sphere", "Rubber")
    compat.set_modifier_input(second, "Metallic Amount", 0.4)
    compat.get_modifier_input(second, "Region").location = (0.5, 0, 0)
    assert [m.name for m in edits(run.splats)] == [first.name, second.name]
    amount, color, surface = (drawn(run, name) for name in (AMOUNT, COLOR, SURFACE))
    made = learned(run, "base_color")[:, :3] * (1 - amount[:, :1]) + color
    np.testing.assert_allclose(made, drawn(run, "base_color")[:, :3], atol=1e-5)
    for column, name in enumerate(("metallic", "roughness")):
        made = learned(run, name) * (1 - amount[:, column + 1]) + surface[:, column]
        np.testing.assert_allclose(made, drawn(run, name), atol=1e-5)
    # Each corner of the mesh has the nearest splat's amount.
    (box,) = run.mesh
    show(run.collection, "mesh")
    bpy.context.view_layer.update()
    shown = box.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    corners = np.array([v.co for v in shown.vertices])
    nearest = np.linalg.norm(corners[:, None] - learned(run, "position")[None], axis=2).argmin(axis=1)
    np.testing.assert_allclose(attribute(shown, AMOUNT), amount[nearest], atol=1e-5)


def test_what_is_removed_takes_its_region_along(run):
    edit = add_edit(run.collection, "Box")
    other = add_edit(run.collection, "Sphere")
    set_material(other, "Copper")
    region = compat.get_modifier_input(edit, "Region").name
    remove_edit(run.splats, edit.name)
    assert region not in bpy.data.objects and len(edits(run.splats)) == 1
    with pytest.raises(InputError, match="has no edit"):
        remove_edit(run.splats, "RefGS Splats")
    with pytest.raises(InputError, match="has no splats"):
        add_edit(bpy.data.collections.new("empty"))


def test_the_buttons(addon, run):
    bpy.context.view_layer.objects.active = run.splats
    assert bpy.ops.refgs.add_edit(where="Sphere", material="Chrome") == {"FINISHED"}
    (edit,) = edits(run.splats)
    region = compat.get_modifier_input(edit, "Region")
    assert bpy.context.view_layer.objects.active == region  # selected, ready to be moved
    bpy.ops.refgs.set_material(splats=run.splats.name, edit=edit.name, material="Rubber")
    assert compat.get_modifier_input(edit, "Metallic") == 0
    bpy.ops.refgs.remove_edit(splats=run.splats.name, edit=edit.name)
    assert not edits(run.splats)
    bpy.data.batch_remove([run.collection])
    assert not bpy.ops.refgs.add_edit.poll()


def test_what_is_painted_on_the_mesh(run):
    """Check that weights painted on the upper half of the mesh edit the splats higher than the whole mesh, but not those lower.

    The mesh is first moved into the middle of the splats.
    """
    run.mesh[0].data.transform(Matrix.Translation((-1, 3, -2)))  # into the middle of the splats
    add_edit(run.collection, "Painted", "Gold")
    canvas = next(item for item in run.collection.objects if item.get("refgs_region"))
    assert canvas.data == run.mesh[0].data and not canvas.modifiers and canvas.hide_render
    np.testing.assert_allclose(drawn(run, "metallic"), learned(run, "metallic"))  # nothing is painted yet
    height = np.array([v.co.z for v in canvas.data.vertices])
    canvas.vertex_groups.active.add(np.flatnonzero(height > height.mean()).tolist(), 1.0, "REPLACE")
    metallic, before, z = drawn(run, "metallic"), learned(run, "metallic"), learned(run, "position")[:, 2]
    above, below = z > height.max(), z < height.min()
    assert above.any() and below.any()
    np.testing.assert_allclose(metallic[above], 1.0, atol=1e-5)
    np.testing.assert_allclose(metallic[below], before[below], atol=1e-5)
    second = add_edit(run.collection, "Painted", "Rubber")  # another layer, on the same copy of the mesh
    assert len([item for item in run.collection.objects if item.get("refgs_region")]) == 1
    np.testing.assert_allclose(drawn(run, "metallic")[above], 1.0, atol=1e-5)
    for edit in (second, edits(run.splats)[0]):
        remove_edit(run.splats, edit.name)
    assert not [item for item in run.collection.objects if item.get("refgs_region")]


def test_the_painted_object_covers_nothing(addon, run):
    """Check that the object to paint on is invisible after painting, and that a click on a part of the run ends painting."""
    first, second = (add_edit(run.collection, "Painted", name) for name in ("Gold", "Rubber"))
    canvas = compat.get_modifier_input(first, "Region")
    assert not any(getattr(canvas, f"visible_{ray}") for ray in ("camera", "diffuse", "glossy", "shadow"))
    for edit in (first, second):
        bpy.ops.refgs.paint_edit(splats=run.splats.name, edit=edit.name)
        assert bpy.context.mode == "PAINT_WEIGHT" and bpy.context.view_layer.objects.active == canvas
        assert canvas.vertex_groups.active.name == compat.get_modifier_input(edit, "Painted")
    bpy.ops.refgs.show(collection=run.collection.name, part="splats")
    assert bpy.context.mode == "OBJECT"
    bpy.data.objects.remove(canvas)
    with pytest.raises(RuntimeError, match="was deleted: remove the edit"):
        bpy.ops.refgs.paint_edit(splats=run.splats.name, edit=first.name)


def test_painting_needs_a_mesh(run_folder, scene):
    (run_folder / "mesh.glb").unlink()
    run = import_run(run_folder, scene)
    with pytest.raises(InputError, match="no mesh to paint on"):
        add_edit(run.collection, "Painted")
    assert not edits(run.splats)


def test_a_crop_hides_what_is_outside_of_its_box(run):
    box = crop(run.splats, run.collection, True)
    places = learned(run, "position")
    assert len(drawn(run, "metallic")) > 0.8 * len(places)  # a new box contains nearly all splats
    box.location, box.scale = (0.5, 0, 0), (0.5, 2, 2)
    inside = (np.abs(places - [0.5, 0, 0]) <= [0.5, 2, 2]).all(axis=1)
    assert len(drawn(run, "metallic")) == inside.sum() > 0
    assert crop(run.splats, run.collection, False) == box
    assert len(drawn(run, "metallic")) == len(places)
    assert crop(run.splats, run.collection, True) == box
