import cv2
import numpy as np
import OpenEXR
import pytest

from refgs.errors import InputError
from refgs.formats.exr import read_exr, write_exr
from refgs.formats.panorama import directions, read_environment, sample

RNG = np.random.default_rng(5)


def test_half_float_panoramas_are_read(tmp_path):
    pixels = np.ones((4, 8, 3), np.float16)
    pixels[0, 0] = [np.inf, np.nan, -1]
    header = {"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": pixels}).write(str(tmp_path / "h.exr"))
    radiance = read_environment(tmp_path / "h.exr")
    assert radiance.dtype == np.float32
    np.testing.assert_array_equal(radiance[0, 0], [65504, 0, 0])
    np.testing.assert_array_equal(radiance[1:], 1)


def test_radiance_panoramas_are_read(tmp_path):
    """Check a Radiance file: red, green and blue in this order, the first row at the top, bright values kept, to 1 % of the brightest."""
    pixels = RNG.random((4, 8, 3)).astype(np.float32)
    pixels[1, 2] = [900.0, 500.0, 20.0]
    cv2.imencode(".hdr", pixels[..., ::-1])[1].tofile(tmp_path / "a.HDR")
    radiance = read_environment(tmp_path / "a.HDR")
    assert radiance.dtype == np.float32
    assert (np.abs(radiance - pixels) <= 0.01 * pixels.max(axis=-1, keepdims=True)).all()


@pytest.mark.parametrize("content", [None, b"", b"text"])
def test_broken_radiance_panoramas_are_one_line(tmp_path, content):
    if content is not None:
        (tmp_path / "a.hdr").write_bytes(content)
    with pytest.raises(InputError, match=r"a.hdr is missing|a.hdr: this is not a Radiance picture") as error:
        read_environment(tmp_path / "a.hdr")
    assert "\n" not in str(error.value)


def test_six_known_directions():
    # Blender's orientation of a world's background: +x in the middle, +y a quarter turn to its left, +z at the top.
    grid = directions(180, 360)
    np.testing.assert_allclose(np.linalg.norm(grid, axis=-1), 1, atol=1e-6)
    for row, column, expected in [
        (90, 180, (1, 0, 0)),
        (90, 90, (0, 1, 0)),
        (90, 0, (-1, 0, 0)),
        (90, 270, (0, -1, 0)),
        (0, 10, (0, 0, 1)),
        (179, 10, (0, 0, -1)),
    ]:
        assert grid[row, column] @ expected > np.cos(np.radians(1.1))


def test_a_bright_texel_comes_back_at_its_direction():
    grid = directions(32, 64)
    for row, column in [(3, 0), (16, 63), (16, 31), (31, 40), (0, 5)]:
        panorama = np.zeros((32, 64, 3), np.float32)
        panorama[row, column] = (1, 2, 3)
        np.testing.assert_allclose(sample(panorama, 7 * grid[row, column]), (1, 2, 3), rtol=1e-3)
        brightest = sample(panorama, grid)[..., 1].argmax()
        assert brightest == row * 64 + column


def test_sampling_is_smooth_across_the_seam_and_finite_at_the_poles():
    grid = directions(64, 128)
    panorama = 1 + grid  # a smooth function on the sphere
    rays = RNG.normal(size=(5000, 3))
    rays[:4] = [(-1, 1e-7, 0), (-1, -1e-7, 0), (0, 0, 1), (0, 0, -1)]
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    assert np.abs(sample(panorama, rays) - (1 + unit)).max() < 0.05
    assert np.abs(sample(panorama, rays) - (1 + unit)).mean() < 2e-3


@pytest.fixture
def look_at(tmp_path):
    """Return a function that renders a view of a panorama with Cycles, and returns the mean colour of the view.

    Its arguments are the panorama, the view's direction (x, y, z) and the field of view in degrees.
    """
    bpy = pytest.importorskip("bpy")
    mathutils = pytest.importorskip("mathutils")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    world = scene.world = bpy.data.worlds.new("light")
    world.use_nodes = True
    world.cycles.sampling_method = "NONE"  # no object is lit, so importance sampling is not needed
    tree = world.node_tree
    texture = tree.nodes.new("ShaderNodeTexEnvironment")
    tree.links.new(texture.outputs["Color"], tree.nodes["Background"].inputs["Color"])
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 1, False
    scene.render.resolution_x = scene.render.resolution_y = 4
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    scene.render.filepath = str(tmp_path / "view.exr")

    def look(panorama, direction, degrees):
        if texture.image is None:
            write_exr(tmp_path / "une lumière.exr", panorama)
            texture.image = bpy.data.images.load(str(tmp_path / "une lumière.exr"))
            assert texture.image.colorspace_settings.name == "Linear Rec.709"
        camera.data.angle = np.radians(degrees)
        camera.rotation_euler = mathutils.Vector(direction).to_track_quat("-Z", "Y").to_euler()
        bpy.ops.render.render(write_still=True)
        return read_exr(tmp_path / "view.exr")[..., :3].mean((0, 1))

    return look


def test_blender_sees_the_same_panorama(look_at):
    panorama = 0.5 + 0.4 * directions(64, 128)
    for direction in np.concatenate([np.eye(3), -np.eye(3)]):
        np.testing.assert_allclose(look_at(panorama, direction, 10), 0.5 + 0.4 * direction, atol=2e-3)


def test_blender_sees_a_lamp_where_it_is_and_nowhere_else(look_at):
    lamp = np.array([0.48, -0.6, 0.64])
    near = np.exp(60 * (directions(128, 256) @ lamp - 1))[..., None]
    panorama = np.float32(50) * near * (1, 0.5, 0.25)
    for signs in np.ndindex(2, 2, 2):
        direction = lamp * (1 - 2 * np.array(signs))
        bright = np.array([50, 25, 12.5]) if signs == (0, 0, 0) else 0
        np.testing.assert_allclose(look_at(panorama, direction, 2), bright, rtol=0.02, atol=0.1)
