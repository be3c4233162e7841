"""Test the list of material presets: those of the add-on, and those that the user saved."""

from types import SimpleNamespace
from unittest.mock import Mock

import bpy
import numpy as np
import pytest

from refgs_addon import compat
from refgs_addon.errors import InputError
from refgs_addon.scene.edit import add_edit, edits
from refgs_addon.scene.material_presets import (
    INPUTS,
    materials,
    read_material,
    remove_material,
    save_material,
    set_material,
)
from refgs_addon.ui.icons import BALL, ball
from refgs_addon.ui.materials_panel import MaterialPresets
from tests.makers import extension

OURS = ["Brushed Steel", "Chrome", "Clay", "Copper", "Glazed Ceramic", "Gold", "Polished", "Rubber", "Silver"]


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Redirect the user's own material presets to a folder that does not exist yet; return its path."""
    (tmp_path / "scripts").mkdir()
    monkeypatch.setenv("BLENDER_USER_SCRIPTS", str(tmp_path / "scripts"))
    return tmp_path / "scripts" / "presets" / "refgs_material"


@pytest.fixture
def edit(run, own):
    """Add an edit, with the preset Gold, to all of the run's splats."""
    return add_edit(run.collection)


def values(edit):
    return {name: compat.get_modifier_input(edit, name) for name in INPUTS}


def test_those_that_come_with_it(own):
    assert list(materials()) == OURS and not own.exists()
    assert read_material("Copper")["Base Color"] == (0.955, 0.638, 0.538, 1.0)
    for name in OURS:
        found = read_material(name)
        assert {"Color Amount", "Metallic", "Metallic Amount", "Roughness", "Roughness Amount"} <= found.keys()
        assert ("Base Color" in found) == (found["Color Amount"] == 1.0)


def test_each_preset_has_a_ball_of_its_color(own):
    for values in map(read_material, OURS):
        color = values.get("Base Color", (0.5,) * 4)[:3]
        pixels = ball(color, values["Metallic"], values["Roughness"])
        assert pixels.shape == (BALL, BALL, 4) and np.isfinite(pixels).all()
        inside = pixels[pixels[..., 3] == 1][:, :3] ** 2.2
        assert 0.7 < (pixels[..., 3] == 1).mean() < 0.8
        if max(color) - min(color) > 0.2:
            assert [*np.argsort(inside.mean(axis=0))] == [*np.argsort(color)]


def test_the_list_removes_only_what_was_saved(addon, edit, own):
    save_material(edit, "Mine")
    drawn = []

    def operator(name, **look):
        drawn.append(SimpleNamespace(which=name, **look))
        return drawn[-1]

    layout = Mock(operator=operator)
    layout.column.return_value = layout.row.return_value = layout
    context = Mock(refgs_edit=edit, window_manager=bpy.context.window_manager)
    MaterialPresets.draw(SimpleNamespace(layout=layout), context)
    assert [button.material for button in drawn if button.which == "refgs.set_material"] == sorted([*OURS, "Mine"])
    assert [button.name for button in drawn if getattr(button, "remove_name", False)] == ["Mine"]


def test_edits_are_named_after_material_and_place(run, own):
    names = [add_edit(run.collection, where, "Chrome").name for where in ("Everywhere", "Box", "Box")]
    assert names == ["Chrome, everywhere", "Chrome, box", "Chrome, box.001"]
    first, second, _ = edits(run.splats)
    set_material(first, "Clay")
    second.name = "the lid"
    set_material(second, "Clay")
    assert [edit.name for edit in edits(run.splats)] == ["Clay, everywhere", "the lid", "Chrome, box.001"]


def test_one_is_saved_used_and_removed(edit, own):
    compat.set_modifier_input(edit, "Base Color", (0.9, 0.5, 0.4, 1.0))
    compat.set_modifier_input(edit, "Roughness", 0.33)
    compat.set_modifier_input(edit, "Color Amount", 0.7)
    file = save_material(edit, "Rosé Gold 2/3")
    assert [*own.iterdir()] == [file] and list(materials()) == sorted([*OURS, "Rosé Gold 2/3"])
    set_material(edit, "Clay")
    assert values(edit)["Roughness"] == pytest.approx(0.9)
    set_material(edit, "Rosé Gold 2/3")
    found = values(edit)
    assert tuple(found["Base Color"]) == pytest.approx((0.9, 0.5, 0.4, 1.0))
    assert (found["Roughness"], found["Color Amount"], found["Metallic"]) == pytest.approx((0.33, 0.7, 1.0))
    remove_material("Rosé Gold 2/3")
    assert list(materials()) == OURS and not [*own.iterdir()]


def test_what_cannot_be_is_said_and_leaves_all_as_it_was(edit, own):
    ours = read_material("Gold")
    for name, said in (("gold", "gold exists already"), ("Brushed_Steel", "already"), (" ", "type one first")):
        with pytest.raises(InputError, match=said):
            save_material(edit, name)
    for name in ("Gold", "Nothing"):
        with pytest.raises(InputError, match="only those can be removed"):
            remove_material(name)
    assert read_material("Gold") == ours and not own.exists()
    own.mkdir(parents=True)
    (own / "Broken.py").write_text("metallic = 'very'\n")
    count, before = len(edits(edit.id_data)), values(edit)["Metallic"]
    with pytest.raises(InputError, match=r"Broken\.py cannot be read .*save it again"):
        set_material(edit, "Broken")
    with pytest.raises(InputError, match=r"Broken\.py cannot be read .*save it again"):
        add_edit(edit.id_data.users_collection[0], "Box", "Broken")
    assert len(edits(edit.id_data)) == count and values(edit)["Metallic"] == before
    with pytest.raises(InputError, match="there is no material Marble: choose one of Broken"):
        set_material(edit, "Marble")


def test_it_can_be_undone(addon, edit):
    splats = edit.id_data.name
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.refgs.set_material("EXEC_DEFAULT", True, splats=splats, edit=edit.name, material="Rubber")
    (edit,) = edits(bpy.data.objects[splats])
    assert values(edit)["Roughness"] == pytest.approx(0.9)
    bpy.ops.ed.undo()
    (edit,) = edits(bpy.data.objects[splats])
    assert values(edit)["Roughness"] == pytest.approx(0.15)


def test_the_buttons(addon, edit, own):
    (folder,) = bpy.utils.preset_paths("refgs_material")
    which = {"splats": edit.id_data.name, "edit": edit.name}
    bpy.ops.refgs.set_material(**which, material="Brushed Steel")
    assert values(edit)["Roughness"] == pytest.approx(0.4)
    which["edit"] = edit.name
    bpy.ops.refgs.keep_material(**which, name="Steel of mine")
    assert bpy.utils.preset_paths("refgs_material") == [str(own), folder]
    assert bpy.ops.refgs.add_edit(where="Everywhere", material="Steel of mine") == {"FINISHED"}
    with pytest.raises(RuntimeError, match="already"):
        bpy.ops.refgs.keep_material(**which, name="Steel of mine")
    bpy.ops.refgs.keep_material(name="Steel of mine", remove_name=True)
    with pytest.raises(RuntimeError, match="only those can be removed"):
        bpy.ops.refgs.keep_material(name="Gold", remove_name=True)
    assert list(materials()) == OURS
    extension.disable()
    assert str(folder) not in bpy.utils.preset_paths("refgs_material")
    extension.enable()
