"""Test rendered previews: Eevee's pixels agree with the panorama's orientation and the camera's projection."""

import math

import bpy
import numpy as np
import pytest
from mathutils import Matrix
from PIL import Image

from refgs.color import srgb_encode
from refgs_addon import compat
from refgs_addon.errors import InputError
from refgs_addon.nodes import add, out
from refgs_addon.nodes.splats_tree import NAME
from refgs_addon.scene.camera_objects import add_camera
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.render_eevee import render_preview
from refgs_addon.scene.run_parts import show
from refgs_addon.scene.world_light import relight
from tests.makers.captures import look_at
from tests.makers.runs import COLUMNS, read_exr, write_panorama, write_ply

SIZE = 64


def coloured_sky(direction):
    """Return the sky's linear RGB radiance in the unit directions (…, 3). No two directions have the same colour."""
    return 0.5 + 0.4 * np.asarray(direction)


def sky_pixels(height=64):
    """Draw the sky as a panorama (height, 2 × height, 3).

    Blender looks a direction up at u = 0.5 - atan2(y, x) / 2π, v = asin(z) / π + 0.5, where v = 1 is the top row.
    """
    u, v = np.meshgrid((np.arange(2 * height) + 0.5) / (2 * height), 1 - (np.arange(height) + 0.5) / height)
    azimuth, elevation = 2 * np.pi * (0.5 - u), np.pi * (v - 0.5)
    level = np.cos(elevation)
    return coloured_sky(np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1))


def camera_at(scene, eye):
    """Add a camera at `eye` that looks at the origin."""
    lens = {"fl_x": float(SIZE), "fl_y": float(SIZE), "cx": SIZE / 2, "cy": SIZE / 2, "w": SIZE, "h": SIZE}
    return add_camera({"name": "view", "transform_matrix": look_at(eye).tolist()} | lens, scene.collection)


def rendered(scene, tmp_path, camera, samples):
    """Render the view of `camera` to a.png and a.exr. Return the pixels of the EXR file: (h, w, 4)."""
    render_preview(scene, tmp_path / "a.png", camera, samples=samples, exr=tmp_path / "a.exr")
    return read_exr(tmp_path / "a.exr")


def one_mirror(folder, normal):
    """Write a run folder with one large opaque splat at the origin.

    The splat is white, metallic and almost smooth, so it mirrors the sky.
    """
    folder.mkdir()
    z = np.asarray(normal, float)
    quaternion = np.array([1 + z[2], -z[1], z[0], 0]) / np.linalg.norm([1 + z[2], -z[1], z[0]])  # z to the normal
    values = dict.fromkeys(COLUMNS, 0.0) | dict(zip(["nx", "ny", "nz"], z, strict=True))
    values |= {f"rot_{i}": quaternion[i] for i in range(4)} | {"opacity": 20.0, "metallic": 1.0, "roughness": 0.02}
    values |= {"albedo_r": 1.0, "albedo_g": 1.0, "albedo_b": 1.0}
    write_ply(folder / "splats.ply", {name: np.array([value]) for name, value in values.items()})
    write_panorama(folder / "environment.exr", sky_pixels())
    return folder


def test_a_mirror_splat_shows_the_sky_it_should(tmp_path, scene):
    normal, eye = np.array([0.48, -0.6, 0.64]), np.array([1.0, -3.0, 1.5])
    import_run(one_mirror(tmp_path / "mirror", normal), scene)
    camera, middle = camera_at(scene, eye), slice(SIZE // 2 - 1, SIZE // 2 + 1)

    def seen():
        return rendered(scene, tmp_path, camera, 16)[middle, middle].mean((0, 1))

    toward = eye / np.linalg.norm(eye)
    mirrored = 2 * (normal @ toward) * normal - toward
    np.testing.assert_allclose(seen(), [*coloured_sky(mirrored), 1], atol=0.03)

    # Rotated by 90° counter-clockwise, at twice the strength: the radiance comes from a quarter turn back.
    write_panorama(tmp_path / "hdri.exr", sky_pixels())
    relight(scene, tmp_path / "hdri.exr", rotation=math.pi / 2, strength=2.0)
    x, y, z = mirrored
    np.testing.assert_allclose(seen(), [*2 * coloured_sky([y, -x, z]), 1], atol=0.06)

    camera.matrix_world = Matrix(look_at(-eye).tolist())  # the back is dark
    np.testing.assert_allclose(seen(), [0, 0, 0, 1], atol=0.01)


def test_the_alpha_is_a_gaussian(tmp_path, scene):
    run = import_run(one_mirror(tmp_path / "mirror", [0, 0, 1]), scene)
    run.splats.data.attributes["opacity"].data[0].value = 0.8
    if compat.DRAWS_SPLATS:
        run.splats.data.attributes["radiance:base"].data[0].vector = (0, 0, 0, 0.8)
    camera = camera_at(scene, [0, -1e-3, 8.0])  # 8 standard deviations across the picture
    alpha = rendered(scene, tmp_path, camera, 100)[..., 3]
    x, y = np.meshgrid((np.arange(SIZE) + 0.5 - SIZE / 2) / 8, (np.arange(SIZE) + 0.5 - SIZE / 2) / 8)
    # Eevee of Blender 5.3 draws splats a little wide: exp(-r²) at r = 2 where it should be at 3 / √2.
    width, extent = (3 / math.sqrt(8), 8) if compat.DRAWS_SPLATS else (1, 3)
    expected = 0.8 * np.exp(-(x**2 + y**2) / (2 * width**2)) * ((abs(x) < extent) & (abs(y) < extent))
    error = alpha - expected
    assert abs(error.mean()) < 0.002 and np.abs(error).mean() < 0.01 and np.abs(error).max() < 0.2
    assert np.abs(error.reshape(8, 8, 8, 8).mean((1, 3))).max() < 0.01


def test_the_recovered_light_comes_back(run, scene, tmp_path):
    image = run.world.node_tree.nodes["RefGS HDRI"]
    recovered = image.image
    write_panorama(tmp_path / "hdri.exr", sky_pixels())
    relight(scene, tmp_path / "hdri.exr", rotation=1.0)
    assert image.image != recovered and scene.world == run.world
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "kept.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "kept.blend"))
    scene = bpy.context.scene
    relight(scene, None)
    nodes = scene.world.node_tree.nodes
    assert nodes["RefGS HDRI"].image.name == "environment.exr"
    assert tuple(nodes["RefGS Rotation"].inputs["Rotation"].default_value) == (0, 0, 0)


def test_relight_leaves_the_artists_own_world_alone(scene, tmp_path):
    own = scene.world = bpy.data.worlds.new("Mine")
    with pytest.raises(InputError, match="no recovered light"):
        relight(scene, None)
    with pytest.raises(InputError, match=r"missing\.exr"):
        relight(scene, tmp_path / "missing.exr")
    assert scene.world == own
    write_panorama(tmp_path / "hdri.exr", sky_pixels())
    relight(scene, tmp_path / "hdri.exr")
    assert scene.world != own and "Mine" in bpy.data.worlds


def test_a_texture_is_read_where_the_surface_is(scene, tmp_path):
    """Draw small triangles that use a quarter of a texture: no pixel shows the rest of it."""
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=3)
    mesh = bpy.context.object.data
    uv = np.empty(2 * len(mesh.loops), np.float32)
    mesh.uv_layers[0].data.foreach_get("uv", uv)
    mesh.uv_layers[0].data.foreach_set("uv", (0.05 + 0.4 * uv.reshape(-1, 2)).ravel())
    image = bpy.data.images.new("quarter", 512, 512, float_buffer=True)
    pixels = np.zeros((512, 512, 4), np.float32)
    pixels[:256, :256] = 1
    image.pixels.foreach_set(pixels.ravel())
    material = bpy.data.materials.new("quarter")
    tree = compat.node_tree(material)
    texture = add(tree, "ShaderNodeTexImage", image=image)
    shader = add(tree, "ShaderNodeEmission", {"Color": texture.outputs["Color"]})
    add(tree, "ShaderNodeOutputMaterial", {"Surface": out(shader)})
    mesh.materials.append(material)
    pixels = rendered(scene, tmp_path, camera_at(scene, [0.0, -3.0, 1.0]), 1)
    solid = pixels[..., 3] > 0.999
    assert solid.sum() > 1000 and pixels[solid].min() > 0.99


def snapshot(struct):
    """Read the settings of a Blender struct: all writable numbers, booleans and texts, by name."""
    kinds = (bool, int, float, str)
    names = [p.identifier for p in struct.bl_rna.properties if not p.is_readonly]
    return {name: getattr(struct, name) for name in names if isinstance(getattr(struct, name), kinds)}


def test_a_preview_puts_the_settings_back(run, scene, tmp_path):
    scene.render.engine, scene.render.film_transparent = "CYCLES", False
    scene.render.resolution_x, scene.render.resolution_percentage = 1234, 50
    scene.render.image_settings.file_format = "JPEG"
    scene.view_settings.view_transform, scene.view_settings.exposure = "AgX", 2.0
    scene.eevee.taa_render_samples = 7
    scene.camera = run.cameras["front"]
    owners = (scene.render, scene.render.image_settings, scene.view_settings, scene.display_settings, scene.eevee)
    before = list(map(snapshot, owners))
    render_preview(scene, tmp_path / "a.png", run.cameras["shifted"], size=16, samples=1)
    assert list(map(snapshot, owners)) == before and scene.camera == run.cameras["front"]
    with pytest.raises(InputError, match=r"cannot write .*b\.png"):
        render_preview(scene, tmp_path / "a.png" / "b.png", size=16, samples=1)
    assert list(map(snapshot, owners)) == before
    assert [p.name for p in tmp_path.glob("*.png")] == ["a.png"]
    scene.camera = None
    with pytest.raises(InputError, match="no camera"):
        render_preview(scene, tmp_path / "b.png")


def test_png_and_exr_are_one_picture(run, scene, tmp_path):
    show(run.collection, "mesh")
    run.mesh[0].location = -np.mean([run.mesh[0].matrix_world @ v.co for v in run.mesh[0].data.vertices], axis=0)
    scene.view_settings.view_transform = "AgX"
    linear = rendered(scene, tmp_path, run.cameras["front"], 4)
    png = np.asarray(Image.open(tmp_path / "a.png")) / 255
    assert png.shape == (SIZE, SIZE, 4)
    np.testing.assert_allclose(png[..., 3], linear[..., 3], atol=0.003)
    solid = linear[..., 3] > 0.999
    assert 20 < solid.sum() < SIZE * SIZE
    np.testing.assert_allclose(png[solid][:, :3], srgb_encode(linear[solid][:, :3]).clip(0, 1), atol=0.01)


def test_the_display_shows_a_value_as_it_is(tmp_path, scene):
    run = import_run(one_mirror(tmp_path / "mirror", [0, 0, 1]), scene)
    run.splats.data.attributes["base_color"].data[0].color = (0.2, 0.4, 0.6, 1)
    compat.set_modifier_input(run.splats.modifiers[NAME], "Display", "Base Color")
    shown = rendered(scene, tmp_path, camera_at(scene, [0, -1e-3, 2.0]), 1)
    np.testing.assert_allclose(shown[SIZE // 2, SIZE // 2], [0.2, 0.4, 0.6, 1], atol=1e-3)
