"""Test contact sheets, one picture per light. Each picture must equal a preview under its light, and the scene must not change."""

import bpy
import numpy as np
import pytest
from PIL import Image

from refgs_addon.errors import InputError
from refgs_addon.nodes.panorama_world import IMAGE, ROTATION, STRENGTH
from refgs_addon.scene.contact_sheet import GAP, contact_sheet
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.render_eevee import render_preview
from refgs_addon.scene.run_parts import show
from refgs_addon.scene.world_light import relight
from tests.makers.runs import write_panorama


def test_a_view_under_each_light(run, scene, tmp_path):
    show(run.collection, "splats")
    scene.eevee.use_raytracing = False  # much faster in software
    colors = {"red": (1, 0.05, 0.05), "green": (0.05, 1, 0.05), "blue": (0.05, 0.05, 1)}
    for name, color in colors.items():
        write_panorama(tmp_path / f"{name}.exr", np.broadcast_to(color, (8, 16, 3)))
    relight(scene, tmp_path / "red.exr", rotation=1.0, strength=2.0)
    said = []
    files = [tmp_path / f"{name}.exr" for name in colors]
    contact_sheet(scene, tmp_path / "a.png", files, size=24, samples=4, progress=lambda *what: said.append(what))
    assert said[0] == (0, "the recovered light") and said[1] == (1, "red") and said[-1][0] == 4
    sheet = np.asarray(Image.open(tmp_path / "a.png"))
    assert sheet.shape == (2 * 24 + GAP, 2 * 24 + GAP, 4)
    low, high = slice(24), slice(24 + GAP, None)
    shown = {"red": sheet[low, high], "green": sheet[high, low], "blue": sheet[high, high]}
    for channel, name in enumerate(colors):
        solid = shown[name][shown[name][..., 3] > 128]
        assert len(solid) and solid[:, :3].mean(axis=0).argmax() == channel
    nodes = scene.world.node_tree.nodes
    assert nodes[IMAGE].image.name == "red.exr" and nodes[STRENGTH].inputs["Strength"].default_value == 2.0
    assert nodes[ROTATION].inputs["Rotation"].default_value[2] == pytest.approx(1.0)
    relight(scene, tmp_path / "green.exr")
    render_preview(scene, tmp_path / "b.png", size=24, samples=4)
    alone = np.asarray(Image.open(tmp_path / "b.png")).astype(int)
    np.testing.assert_allclose(shown["green"], alone, atol=12)  # samples are random


def test_without_lights_or_a_place_to_write(run_folder, scene, tmp_path):
    (run_folder / "environment.exr").unlink()
    import_run(run_folder, scene)
    with pytest.raises(InputError, match="no light to render under"):
        contact_sheet(scene, tmp_path / "a.png", [])
    write_panorama(tmp_path / "grey.exr", np.ones((8, 16, 3)))
    with pytest.raises(InputError, match="cannot write"):
        contact_sheet(scene, tmp_path / "not there" / "a.png", [tmp_path / "grey.exr"], size=8, samples=1)
    assert scene.world is None and not bpy.data.worlds
    own = scene.world = bpy.data.worlds.new("the artist's own")
    contact_sheet(scene, tmp_path / "a.png", [tmp_path / "grey.exr"], size=8, samples=1)
    with pytest.raises(InputError, match="cannot read the light"):
        contact_sheet(scene, tmp_path / "a.png", [tmp_path / "not there.exr"], size=8, samples=1)
    assert [*bpy.data.worlds] == [scene.world] == [own] and not own.use_fake_user
