"""Test that a training's decisions about a scene are shown as choices: kept, or trained again the other way."""

import json
from pathlib import Path
from unittest.mock import Mock

import bpy
import cv2
import numpy as np
import pytest

from refgs_addon.errors import InputError
from refgs_addon.trainer.scene import decisions, training
from refgs_addon.trainer.ui import decisions_box
from tests.makers.waiting import until


@pytest.fixture
def run(addon, fake_trainer, tmp_path):
    """List a run in the scene that was taken for matte. Return its folder."""
    capture, folder = tmp_path / "photos", tmp_path / "run"
    capture.mkdir()
    (folder / "needs").mkdir(parents=True)
    addon.refgs.capture = str(capture)
    known = addon.refgs.runs.add()
    known.folder, known.capture = str(folder), str(capture)
    files = {kind: f"needs/specular_{kind}.png" for kind in ("on", "off", "photo")}
    for file in files.values():
        cv2.imwrite(str(folder / file), np.zeros((8, 8, 3), np.uint8))
    shown = files | {"view": "0003", "psnr_on": 31.24, "psnr_off": 31.1}
    row = {"need": "specular", "what": "specular shading", "why": "it explains 0.10 dB", "needed": False}
    rows = [
        row | {"pictures": shown},
        {"need": "iterations", "what": "all iterations", "why": "matte", "needed": False},
    ]
    (folder / "needs.json").write_text(json.dumps(rows))
    return folder


def draw(scene, folder):
    """Draw a run's decisions, and return what was drawn: labels, pictures, and the buttons' texts."""
    layout = Mock()
    layout.box.return_value = layout.row.return_value = layout.column.return_value = layout
    decisions_box.draw_decisions(layout, scene, folder, 60)
    labels = [call.kwargs["text"] for call in layout.label.call_args_list]
    buttons = [call.kwargs["text"] for call in layout.operator.call_args_list]
    return labels, layout.template_icon.call_args_list, buttons


def test_a_decision_is_a_choice_with_pictures(addon, run, monkeypatch):
    pictures = Mock(side_effect=[1, 2, 3])
    monkeypatch.setattr(decisions_box, "thumbnail", pictures)  # Blender has no icons without a window
    labels, icons, buttons = draw(addon, run)
    assert labels[0] == "Gloss: Matte" and "It explains 0.10 dB" in labels
    assert labels[-6:] == ["Glossy", "31.24 dB", "Matte", "31.10 dB", "Photo", "0003"]
    assert [icon.kwargs["icon_value"] for icon in icons] == [1, 2, 3]
    assert [Path(call.args[0]).name for call in pictures.call_args_list] == [
        "specular_on.png",
        "specular_off.png",
        "specular_photo.png",
    ]
    assert buttons == ["Keep Matte", "Train Glossy"]


def test_a_decision_is_kept(addon, run, tmp_path):
    assert bpy.ops.refgs.keep_decision(folder=str(run), need="specular") == {"FINISHED"}
    assert draw(addon, run) == ([], [], [])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert not decisions.open_decisions(bpy.context.scene, run)
    rows = json.loads((run / "needs.json").read_text())
    rows[0]["needed"] = True  # the second look brought it back: this was not confirmed
    (run / "needs.json").write_text(json.dumps(rows) + " ")
    (decision,) = decisions.open_decisions(bpy.context.scene, run)
    assert (decision.answer, decision.other) == ("on", "off")


def test_the_other_way_is_trained(addon, run, tmp_path):
    assert bpy.ops.refgs.train_other_way(folder=str(run), need="specular") == {"FINISHED"}
    out = tmp_path / "run 2"
    until(lambda: (out / "started").is_file() and (out / "started").read_text())
    assert json.loads((out / "started").read_text())["settings"] == ["needs.specular=on"]
    assert addon.refgs.specular == "on" and [Path(known.folder) for known in addon.refgs.runs] == [run, out]
    addon.refgs.capture = str(tmp_path)
    with pytest.raises(InputError, match="choose that capture first"):
        training.train_other_way(addon, run, "specular")
    with pytest.raises(InputError, match="no decision about light"):
        training.train_other_way(addon, run, "light")


@pytest.mark.parametrize("text", ["", "[1]", '[{"pictures": {}}]', '[{"pictures": {"on": 3}}]', "{}"])
def test_a_broken_file_has_no_decisions(run, text):
    (run / "needs.json").write_text(text)
    assert decisions.decisions(run) == [] and decisions.decisions(run / "nowhere") == []
