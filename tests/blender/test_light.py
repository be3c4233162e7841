"""Test the scene's light: list the panoramas, choose one, and rotate it to match the light that the training recovered."""

import math

import bpy
import numpy as np
import pytest

from refgs_addon.errors import InputError
from refgs_addon.nodes.panorama_world import IMAGE, ROTATION, STRENGTH
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.panorama import best_rotation
from refgs_addon.scene.world_light import hdris, load_panorama, match_light, relight
from refgs_addon.ui import light_panel
from tests.makers.runs import write_panorama


def room(height=48, seed=0):
    """Return a function that draws a dim panorama with four random lamps, rotated by an angle: (height, 2 × height, 3)."""
    rng = np.random.default_rng(seed)
    azimuth = math.pi * (1 - 2 * (np.arange(2 * height) + 0.5) / (2 * height))
    elevation = math.pi * (0.5 - (np.arange(height) + 0.5) / height)[:, None]

    def at(turn):
        """Draw the panorama, rotated by `turn` radians, counter-clockwise seen from above."""
        values = 0.2 + 0.1 * np.sin(elevation) + 0 * azimuth
        for where, up, bright in lamps:
            cosine = np.cos(azimuth - turn - where) * np.cos(elevation) * np.cos(up) + np.sin(elevation) * np.sin(up)
            values = values + bright * np.exp(20 * (cosine - 1))
        return np.repeat(values[..., None], 3, axis=2)

    lamps = [(rng.uniform(-3, 3), rng.uniform(-0.5, 1.2), rng.uniform(1, 20)) for _ in range(4)]
    return at


@pytest.mark.parametrize("turn", [0.0, 1.0, -2.5, 3.1])
def test_the_turn_between_two_panoramas_is_found(turn, scene, tmp_path):
    write_panorama(tmp_path / "a.exr", room()(0))
    a = load_panorama(tmp_path / "a.exr")
    for height, degrees, relative in ((48, 0.5, 0.01), (100, 1, 0.02)):  # the same size, and no integer multiple of it
        write_panorama(tmp_path / f"{height}.exr", 2.5 * room(height)(turn))
        found, scale = best_rotation(a, load_panorama(tmp_path / f"{height}.exr"))
        assert abs((found - turn + math.pi) % (2 * math.pi) - math.pi) < math.radians(degrees)
        assert scale == pytest.approx(2.5, rel=relative)


def test_an_hdri_is_matched_to_the_recovered_light(run_folder, scene, tmp_path):
    panorama = room()
    write_panorama(run_folder / "environment.exr", 3 * panorama(0.7))
    import_run(run_folder, scene)
    with pytest.raises(InputError, match="choose an HDRI first"):
        match_light(scene)
    write_panorama(tmp_path / "hdri.exr", panorama(0))
    relight(scene, tmp_path / "hdri.exr")
    match_light(scene)
    nodes = scene.world.node_tree.nodes
    assert nodes[ROTATION].inputs["Rotation"].default_value[2] == pytest.approx(0.7, abs=0.01)
    assert nodes[STRENGTH].inputs["Strength"].default_value == pytest.approx(3, rel=0.01)
    scene.world = None
    with pytest.raises(InputError, match="no recovered light to match"):
        match_light(scene)


def test_blenders_own_and_the_artists_hdris_are_at_hand(scene, tmp_path):
    own = {file.stem for file in hdris()}
    assert {"city", "studio", "sunset"} <= own
    write_panorama(tmp_path / "my room.exr", np.ones((8, 16, 3)))
    (tmp_path / "notes.txt").write_text("")
    assert {file.stem for file in hdris(tmp_path)} - own == {"my room"}
    assert hdris(tmp_path / "not there") == hdris()


def test_the_chooser_says_and_sets_what_lights_the_scene(run_folder, addon, monkeypatch, tmp_path):
    write_panorama(tmp_path / "my room.exr", np.ones((8, 16, 3)))
    monkeypatch.setattr(light_panel, "hdri_folder", lambda: tmp_path)
    manager = bpy.context.window_manager
    assert manager.refgs_light == "OTHER"
    manager.refgs_light = str(hdris()[0])
    assert addon.world.node_tree.nodes[IMAGE].image.name == hdris()[0].name  # in a new world
    import_run(run_folder, addon)
    assert manager.refgs_light == "RECOVERED"
    nodes = addon.world.node_tree.nodes
    strength = nodes[STRENGTH].inputs["Strength"]
    strength.default_value = 2.0
    manager.refgs_light = str(tmp_path / "my room.exr")
    assert nodes[IMAGE].image.name == "my room.exr" and manager.refgs_light == str(tmp_path / "my room.exr")
    assert strength.default_value == 2.0
    manager.refgs_light = "RECOVERED"
    assert nodes[IMAGE].image.name == "environment.exr" and strength.default_value == 1.0
