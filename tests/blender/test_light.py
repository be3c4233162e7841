"""Test the scene's light: list the panoramas, choose one, and rotate it to match the light that the training recovered."""

import math
import tracemalloc

import bpy
import numpy as np
import pytest

from refgs_addon import compat
from refgs_addon.errors import InputError
from refgs_addon.nodes import world_diffuse
from refgs_addon.nodes.panorama_world import IMAGE, ROTATION, STRENGTH
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.panorama import best_rotation
from refgs_addon.scene.render_eevee import render_preview
from refgs_addon.scene.run_parts import show
from refgs_addon.scene.world_light import correct_diffuse, hdris, load_panorama, match_light, relight
from refgs_addon.ui import light_panel
from tests.makers.runs import read_exr, write_panorama


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


def test_a_menu_of_lights_outlives_its_list(run_folder, addon, monkeypatch, tmp_path):
    """Check that a light's number fits the float32 of a button, and that the texts in an open menu are not freed by the next list."""
    import_run(run_folder, addon)
    before = light_panel._lights(None, bpy.context)
    write_panorama(tmp_path / "a room.exr", np.ones((8, 16, 3)))
    monkeypatch.setattr(light_panel, "hdri_folder", lambda: tmp_path)
    after = {item[0]: item for item in light_panel._lights(None, bpy.context)}
    assert len(after) == len(before) + 1 == len({item[4] for item in after.values()})
    for item in before:
        assert all(old is new for old, new in zip(item[:3], after[item[0]][:3], strict=True))
        assert item[4] == after[item[0]][4] == int(np.float32(item[4]))


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


def test_a_light_is_known_by_its_relative_path(addon, monkeypatch, tmp_path):
    """Check that a light that was chosen after the first save is stored relative to the .blend, and that the chooser knows it."""
    for folder in ("hdris", "project"):
        (tmp_path / folder).mkdir()
    file = tmp_path / "hdris" / "room.exr"
    write_panorama(file, np.ones((8, 16, 3)))
    monkeypatch.setattr(light_panel, "hdri_folder", lambda: file.parent)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "project" / "a.blend"))
    relight(addon, file)
    bpy.ops.wm.save_mainfile()
    assert addon.world.node_tree.nodes[IMAGE].image.filepath == "//../hdris/room.exr"
    assert bpy.context.window_manager.refgs_light == str(file)


def half_sky(height=32):
    """Draw a panorama whose side towards +x is bright and orange, and whose other side is dim: (height, 2 × height, 3)."""
    azimuth = math.pi * (1 - 2 * (np.arange(2 * height) + 0.5) / (2 * height))
    elevation = math.pi * (0.5 - (np.arange(height) + 0.5) / height)[:, None]
    bright = np.cos(azimuth) * np.cos(elevation) > 0.8
    return np.where(bright[..., None], [8.0, 4.0, 2.0], [0.1, 0.1, 0.2])


def irradiance(panorama, normals, turn):
    """Compute the irradiance over π (N, 3) at unit normals (N, 3), under a panorama that is rotated by `turn` about z. By summation."""
    height = len(panorama)
    azimuth = math.pi * (1 - 2 * (np.arange(2 * height) + 0.5) / (2 * height)) + turn
    elevation = math.pi * (0.5 - (np.arange(height) + 0.5) / height)[:, None]
    x, y, z = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth
    area = np.cos(elevation) * (math.pi / height) ** 2
    cosines = np.maximum(np.einsum("na,ahw->nhw", normals, np.stack([x, y, z])), 0) * area / math.pi
    return np.einsum("nhw,hwc->nc", cosines, panorama)


def balls(scene, file, turn, corrected):
    """Render a white ball without gloss and a metal one in Eevee, each seen from +x. Returns their radiances (P, 3) and normals (P, 3).

    With `corrected`, their materials have the node group `world_diffuse`.
    """
    for metallic, y in ((0.0, -1.0), (1.0, 1.0)):
        bpy.ops.mesh.primitive_uv_sphere_add(segments=96, ring_count=48, radius=1.0, location=(0.0, y, 0.0))
        bpy.ops.object.shade_smooth()
        material = bpy.data.materials.new("ball")
        material.use_nodes = True
        shader = material.node_tree.nodes["Principled BSDF"].inputs
        shader["Base Color"].default_value, shader["Specular IOR Level"].default_value = (1.0, 1.0, 1.0, 1.0), 0.0
        shader["Metallic"].default_value, shader["Roughness"].default_value = metallic, 0.4
        if corrected:
            world_diffuse.add_world_diffuse(material)
        bpy.context.object.data.materials.append(material)
    camera = bpy.data.cameras.new("camera")
    camera.type, camera.ortho_scale = "ORTHO", 4.0
    item = bpy.data.objects.new("camera", camera)
    item.location, item.rotation_euler = (5.0, 0.0, 0.0), (math.pi / 2, 0.0, math.pi / 2)
    scene.collection.objects.link(item)
    scene.render.resolution_x, scene.render.resolution_y = 64, 32
    scene.eevee.use_shadows = False
    relight(scene, file, rotation=turn)
    render_preview(scene, file.with_suffix(".png"), item, samples=8, exr=file.with_name("out.exr"))
    picture = read_exr(file.with_name("out.exr"))
    across, up = (np.arange(32) + 0.5) / 16 - 1, 1 - (np.arange(32)[:, None] + 0.5) / 16
    depth = 1 - across**2 - up**2
    inside = depth > 0.1
    normals = np.stack([np.sqrt(depth.clip(0)), across + 0 * up, up + 0 * across], axis=-1)[inside]
    return picture[:, :32, :3][inside], picture[:, 32:, :3][inside], normals


def test_diffuse_light_in_eevee_is_the_worlds_irradiance(scene, tmp_path):
    panorama, turn = half_sky(), 1.0
    write_panorama(tmp_path / "sky.exr", panorama)
    white, metal, normals = balls(scene, tmp_path / "sky.exr", turn, corrected=True)
    expected = irradiance(panorama, normals, turn)
    error = np.abs(white - expected).mean() / expected.mean()
    assert error < 0.04
    bpy.ops.wm.read_factory_settings(use_empty=True)
    plain, plain_metal, _ = balls(bpy.context.scene, tmp_path / "sky.exr", turn, corrected=False)
    assert error < 0.3 * np.abs(plain - expected).mean() / expected.mean()  # what Eevee does alone
    np.testing.assert_allclose(metal, plain_metal, rtol=0.02, atol=0.01)


def test_only_eevee_and_only_worlds_of_ours_are_corrected(run_folder, scene, tmp_path):
    write_panorama(tmp_path / "sky.exr", half_sky())
    show(import_run(run_folder, scene).collection, "splats")
    relight(scene, tmp_path / "sky.exr")
    tree = bpy.data.node_groups[world_diffuse.NAME]
    switch = next(node for node in tree.nodes if node.label == "Only in Eevee")
    for engine, on in (("CYCLES", 0.0), (compat.EEVEE, 1.0), ("BLENDER_WORKBENCH", 0.0)):
        scene.render.engine = engine
        bpy.context.view_layer.update()
        assert switch.outputs[0].default_value == on
    assert harmonics(tree)[1, 0] > harmonics(tree)[1, 2] > 0.1
    scene.world = bpy.data.worlds.new("the artist's own")
    correct_diffuse(scene)
    assert not harmonics(tree)[1:].any() and harmonics(tree)[0].all()


def harmonics(tree):
    """Return the light that the node group `RefGS World Diffuse` is set to, (9, 3)."""
    return np.array([[x.default_value for x in tree.nodes[f"Harmonic {i}"].inputs] for i in range(9)])


def test_a_rotation_reads_no_pixels(addon, tmp_path):
    """Check that the diffuse light follows an animated rotation by one node's value: its harmonics are those of the panorama."""
    write_panorama(tmp_path / "sky.exr", half_sky(512))
    tree = world_diffuse.world_diffuse_group()
    relight(addon, tmp_path / "sky.exr")
    before = harmonics(tree)
    angle = addon.world.node_tree.nodes[ROTATION].inputs["Rotation"]
    for frame in (1, 11):
        angle.default_value = 0.0, 0.2, frame / 10
        angle.keyframe_insert("default_value", frame=frame)
    tracemalloc.start()
    for frame in (1, 11):
        addon.frame_set(frame)
        turned = tree.nodes[world_diffuse.ROTATION].inputs["Rotation"].default_value
        assert tuple(turned) == pytest.approx((0.0, 0.2, frame / 10))
    assert tracemalloc.get_traced_memory()[1] < 1e5  # bytes; the panorama has 8 million
    tracemalloc.stop()
    np.testing.assert_array_equal(harmonics(tree), before)


def test_the_group_of_an_earlier_file_learns_to_rotate(scene, tmp_path):
    write_panorama(tmp_path / "sky.exr", half_sky())
    tree = world_diffuse.world_diffuse_group()
    links = len(tree.links)
    node = tree.nodes[world_diffuse.ROTATION]
    tree.links.new(node.inputs["Vector"].links[0].from_socket, node.outputs[0].links[0].to_socket)
    tree.nodes.remove(node)
    relight(scene, tmp_path / "sky.exr", rotation=1.0)
    assert tree.nodes[world_diffuse.ROTATION].inputs["Rotation"].default_value[2] == 1.0
    assert len(tree.links) == links
