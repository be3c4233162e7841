"""Test that a run is coloured by where its photos do not tell metal from paint, and has its materials back."""

import json
from functools import partial
from types import SimpleNamespace
from unittest.mock import Mock

import bpy
import cv2
import numpy as np
import pytest

from refgs.formats.gltf import write_glb
from refgs_addon import compat
from refgs_addon.errors import InputError
from refgs_addon.nodes.doubt_material import DOUBTFUL, TOLD
from refgs_addon.nodes.splats_tree import NAME
from refgs_addon.scene.doubt import doubt_shown, has_doubt, show_doubt
from refgs_addon.scene.export_run import export_splats
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.render_eevee import render_preview
from refgs_addon.scene.run_parts import show
from refgs_addon.scene.splat_cloud import read_splats
from refgs_addon.ui.materials_panel import MaterialPanel
from tests.makers import blender
from tests.makers.box import SIZE, textured_box
from tests.makers.runs import COUNT, random_columns, write_ply

WORDS = "photos do not tell metal from paint on 12% of the surface"


@pytest.fixture
def doubtful(run_folder):
    """Write a run whose splats are in doubt from 0 to 1, and its mesh in stripes."""
    write_ply(run_folder / "splats.ply", random_columns() | {"doubt": np.linspace(0, 1, COUNT)})
    write_glb(run_folder / "mesh.glb", *textured_box())
    stripes = 255 * (np.arange(SIZE) // 8 % 2)
    cv2.imwrite(str(run_folder / "textures" / "doubt.png"), np.tile(stripes, (SIZE, 1)).astype(np.uint8))
    (run_folder / "metrics.json").write_text(json.dumps({"doubt": {"part": 0.12, "what": WORDS}}))
    return run_folder


def displayed(run):
    """Return the colours of the drawn splats."""
    return blender.drawn(run.splats, "display")


def mixed(doubt):
    return np.array(TOLD) + (np.array(DOUBTFUL) - TOLD) * np.asarray(doubt)[:, None]


def test_splats_are_colored_and_have_their_material_back(doubtful, scene):
    run = import_run(doubtful, scene)
    show(run.collection, "splats")
    assert has_doubt(run.collection) and not doubt_shown(run.collection)
    show_doubt(run.collection, True)
    assert doubt_shown(run.collection)
    np.testing.assert_allclose(displayed(run)[:, :3], mixed(np.linspace(0, 1, COUNT))[:, :3], atol=1e-5)
    show_doubt(run.collection, False)
    assert blender.drawn_material(run.splats) == run.splats.data.materials[0].name
    assert not doubt_shown(run.collection)


def test_a_run_that_does_not_say_is_black(run):
    assert not has_doubt(run.collection)
    show(run.collection, "splats")
    compat.set_modifier_input(run.splats.modifiers[NAME], "Display", "Doubt")
    assert (displayed(run)[:, :3] == 0).all()


def test_the_mesh_is_colored_and_nothing_stays_behind(doubtful, scene):
    run = import_run(doubtful, scene)
    before = {*bpy.data.materials, *bpy.data.images, *run.mesh[0].modifiers}
    for _ in range(2):
        show_doubt(run.collection, True)
    assert doubt_shown(run.collection)
    shown = run.mesh[0].evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    assert [material.name for material in shown.materials][-1] == f"{run.mesh[0].name} doubt"
    assert {polygon.material_index for polygon in shown.polygons} == {len(shown.materials) - 1}
    show_doubt(run.collection, False)
    assert {*bpy.data.materials, *bpy.data.images, *run.mesh[0].modifiers} == before
    assert not doubt_shown(run.collection)


def test_a_mesh_without_the_texture_is_said_in_one_line(doubtful, scene):
    (doubtful / "textures" / "doubt.png").unlink()
    run = import_run(doubtful, scene)
    with pytest.raises(InputError, match=r"doubt\.png does not exist: show the splats"):
        show_doubt(run.collection, True)
    assert not doubt_shown(run.collection)
    show(run.collection, "splats")
    show_doubt(run.collection, True)
    assert doubt_shown(run.collection)


def test_edits_are_exported_with_the_doubt(doubtful, scene, tmp_path):
    export_splats(import_run(doubtful, scene).collection, tmp_path / "s.ply")
    np.testing.assert_allclose(read_splats(tmp_path / "s.ply")[0]["doubt"], np.linspace(0, 1, COUNT), atol=1e-6)


def drawn(scene):
    """Draw the panel Materials. Returns its labels, and the values of its buttons by operator."""
    layout, buttons = Mock(), {}
    layout.column.return_value = layout
    layout.operator = lambda name, **options: buttons.setdefault(name, SimpleNamespace(**options))
    layout.box.return_value.label, layout.box.return_value.row.return_value.operator = layout.label, layout.operator
    context = Mock(scene=scene, view_layer=bpy.context.view_layer)
    context.region.width, context.preferences.system.ui_scale, context.workspace.use_filter_by_owner = 600, 1, False
    MaterialPanel.draw(SimpleNamespace(layout=layout, _doubt=partial(MaterialPanel._doubt, None)), context)
    return [call.kwargs["text"] for call in layout.label.call_args_list], buttons


def test_the_panel_says_it_and_has_a_toggle(doubtful, addon):
    run = import_run(doubtful, addon)
    labels, buttons = drawn(addon)
    assert " ".join(labels) == WORDS.replace("photos", "Photos", 1)
    button = buttons["refgs.show_doubt"]
    assert button.on and not button.depress
    bpy.ops.refgs.show_doubt(on=True)
    assert doubt_shown(run.collection)
    button = drawn(addon)[1]["refgs.show_doubt"]
    assert not button.on and button.depress
    bpy.ops.refgs.show_doubt(on=False)
    assert not doubt_shown(run.collection)


def test_the_panel_does_not_ask_for_what_a_run_does_not_say(run_folder, addon):
    assert not bpy.ops.refgs.show_doubt.poll()
    import_run(run_folder, addon)
    assert drawn(addon) == ([], {}) and not bpy.ops.refgs.show_doubt.poll()


def test_a_picture_of_the_mesh_has_both_colors(doubtful, scene, tmp_path):
    run = import_run(doubtful, scene)
    show_doubt(run.collection, True)
    camera = run.cameras["front"]
    render_preview(scene, tmp_path / "shown.png", camera, 64, samples=4)
    found = cv2.imread(str(tmp_path / "shown.png"), cv2.IMREAD_UNCHANGED)
    solid = found[found[..., 3] == 255][:, 2::-1].astype(float) / 255
    assert len(solid) > 50
    for color in (TOLD, DOUBTFUL):
        encoded = [12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055 for x in color[:3]]
        assert (np.abs(solid - encoded).max(axis=1) < 0.02).mean() > 0.1


@pytest.mark.parametrize("damaged", ["", "{", '{"questions": [{}]}', "[]"])
def test_the_panel_asks_what_photos_leave_open(doubtful, addon, damaged):
    rows = [{"part": part, "now": "paint", "picture": "questions/1.png", "points": [[0, 0, 0]]} for part in (0.2, 0.1)]
    (doubtful / "questions.json").write_text(damaged or json.dumps({"questions": rows}))
    import_run(doubtful, addon)
    labels, buttons = drawn(addon)
    asked = [] if damaged else ["Metal or paint? 20%, now paint", "Metal or paint? 10%, now paint"]
    assert [label for label in labels if "?" in label] == asked
    assert ("refgs.hint" in buttons) == bool(asked)
