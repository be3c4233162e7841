"""Test the loading of photos: broken files are refused; masks, undistortion and resizing add no colours of their own."""

import json
import struct
import zlib
from dataclasses import replace

import cv2
import numpy as np
import OpenEXR
import pillow_heif
import pytest
import tifffile
from PIL import ExifTags, Image

from refgs.camera import Camera
from refgs.capture import View, load_view, read_capture
from refgs.capture.check import check
from refgs.capture.files import find_photos
from refgs.capture.images import (
    has_gain_map,
    read_codes,
    read_focal_length,
    read_header,
    read_image,
    read_mask,
    write_for_colmap,
)
from refgs.color import srgb_decode
from refgs.errors import InputError
from refgs.formats.exr import write_exr
from tests.makers import gain_maps
from tests.makers.captures import colmap, edit, nerf_blender, nerfstudio, write, write_as_phone
from tests.makers.dng import write_dng

OPENCV = (4, "OPENCV", [60.0, 61.0, 31.0, 25.0, -0.2, 0.05, 0.003, -0.002])


INSIDE = np.hypot(*np.mgrid[-10:10, -15:15]) < 7


def _palette(path, colors: list[tuple[int, int, int]], labels: np.ndarray) -> None:
    picture = Image.fromarray(labels.astype(np.uint8), "P")
    picture.putpalette([value for color in colors for value in color])
    picture.save(path)


def _davis(path) -> None:
    _palette(path, [(0, 0, 0), (128, 0, 0), (0, 128, 0)], INSIDE)


def _two_objects(path) -> None:
    _palette(path, [(0, 0, 0), (128, 0, 0), (0, 128, 0), (64, 0, 0)], INSIDE * np.where(np.arange(30) < 15, 1, 3))


def _bright_background(path) -> None:
    _palette(path, [(230, 25, 75), (60, 180, 75)], INSIDE)


def _labels_all_black(path) -> None:
    _palette(path, [(0, 0, 0)] * 4, 2 * INSIDE)


def _grey_palette(path) -> None:
    _palette(path, [(255, 255, 255), (0, 0, 0)], ~INSIDE)


@pytest.mark.parametrize(
    ("name", "save"),
    [
        *(
            (f"{low}-{high}.png", np.where(INSIDE, high, low).astype(np.uint8))
            for low, high in ((0, 1), (0, 2), (0, 100), (0, 255))
        ),
        *(
            (f"{low}-{high}.png", np.where(INSIDE, high, low).astype(np.uint8))
            for low, high in ((1, 2), (10, 90), (128, 255))
        ),
        *((f"16-{high}.png", np.where(INSIDE, high, 0).astype(np.uint16)) for high in (1, 100, 255, 256, 65535)),
        ("16.tiff", np.where(INSIDE, 7, 3).astype(np.uint16)),
        ("32.tiff", np.where(INSIDE, 2, 1).astype(np.int32)),
        ("float.tiff", np.where(INSIDE, 1, 0).astype(np.float32)),
        ("bits.png", INSIDE),
        ("color.png", np.where(INSIDE[..., None], (0, 128, 0), 0).astype(np.uint8)),
        ("alpha.png", np.dstack([np.zeros((20, 30, 3)), np.where(INSIDE, 100, 0)]).astype(np.uint8)),
        ("davis.png", _davis),
        ("two-objects.png", _two_objects),
        ("bright.png", _bright_background),
        ("black.gif", _labels_all_black),
        ("grey.png", _grey_palette),
    ],
)
def test_two_values_of_any_kind_are_a_mask(tmp_path, name, save):
    path = tmp_path / name
    save(path) if callable(save) else Image.fromarray(save).save(path)
    assert np.array_equal(read_mask(path), np.where(INSIDE, 255, 0))


def test_a_soft_mask_keeps_its_edge(tmp_path):
    values = np.tile(np.linspace(0, 250, 30).astype(np.uint8), (20, 1))
    Image.fromarray(values).save(tmp_path / "a.png")
    Image.fromarray(values.astype(np.uint16) * 257).save(tmp_path / "b.png")
    for name in ("a.png", "b.png"):
        assert np.array_equal(read_mask(tmp_path / name), values)


@pytest.mark.parametrize(("value", "read"), [(0, 0), (1, 255), (128, 255), (255, 255)])
def test_masks_of_one_value(tmp_path, value, read):
    Image.fromarray(np.full((20, 30), value, np.uint8)).save(tmp_path / "a.png")
    assert (read_mask(tmp_path / "a.png") == read).all()


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_16_bit_and_greyscale_are_read(tmp_path, suffix, channels):
    rng = np.random.default_rng(0)
    values = rng.integers(0, 65536, (20, 30, channels)).astype(np.uint16)
    path = tmp_path / f"ö{suffix}"
    write(path, values if channels > 1 else values[..., 0])
    image, alpha = read_image(path)
    assert image.shape == (20, 30, 3) and image.dtype == np.uint8
    assert np.abs(image - values[..., : min(3, channels)] / 257.0).max() < 1
    if channels == 4:
        assert np.abs(alpha - values[..., 3] / 257.0).max() < 1
    else:
        assert alpha is None


def test_greyscale_with_8_bits_is_read(tmp_path):
    grey = np.arange(200, dtype=np.uint8).reshape(10, 20)
    write(tmp_path / "a.png", grey)
    assert np.array_equal(read_image(tmp_path / "a.png")[0], np.repeat(grey[..., None], 3, axis=2))


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp", ".tiff"])
@pytest.mark.parametrize("kept", [0.2, 0.6, 0.97])
def test_truncated_images_are_refused_by_name(tmp_path, suffix, kept):
    path = tmp_path / f"photo{suffix}"
    write(path, np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8))
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])
    with pytest.raises(InputError, match=f"photo{suffix}") as error:
        read_image(path)
    assert "\n" not in str(error.value)


def smooth(height: int, width: int) -> np.ndarray:
    """Draw soft blots of random colours: RGB (height, width, 3) uint8."""
    blots = np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)
    return cv2.resize(blots, (width, height), interpolation=cv2.INTER_LINEAR)


@pytest.mark.parametrize("turns", range(4))
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif", ".heic", ".HEIF"])
def test_photos_of_phones_are_read_upright(tmp_path, suffix, turns):
    path, upright = tmp_path / f"IMG{suffix}", smooth(48, 64)
    write_as_phone(path, upright, turns)
    image, alpha = read_image(path)
    assert alpha is None and read_header(path).upright == (64, 48)
    assert image.shape == upright.shape and np.abs(image.astype(int) - upright).mean() < 6


def test_truncated_heic_is_refused(tmp_path):
    path = tmp_path / "photo.heic"
    write_as_phone(path, np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8))
    data = path.read_bytes()
    for kept in (0.02, 0.3, 0.97):
        path.write_bytes(data[: int(kept * len(data))])
        with pytest.raises(InputError, match=r"photo\.heic"):
            read_image(path)


def test_broken_exif_is_ignored(tmp_path):
    path = tmp_path / "a.jpg"
    Image.fromarray(smooth(48, 64)).save(path, exif=b"Exif\0\0II*\0 garbage")
    assert read_header(path) == (64, 48, False, 0) and read_focal_length(path) is None


@pytest.mark.parametrize(("turns", "as_stored"), [(1, True), (2, True), (3, True), (1, False), (3, False)])
def test_cameras_and_masks_turn_with_their_photo(tmp_path, turns, as_stored):
    """Check that a photo stored sideways is loaded like the upright one, with its camera, its lens and its mask.

    The transforms JSON has the camera of the photo as stored, or of the upright photo.
    """
    photo, mask = smooth(48, 64), np.tri(48, 64, dtype=np.uint8) * 255
    own = {"w": 64, "h": 48, "fl_x": 60.0, "fl_y": 61.0, "cx": 31.0, "cy": 25.0, "k1": -0.1, "p1": 0.004, "p2": -0.002}

    def loaded(folder, turns, mask):
        write_as_phone(folder / "images" / "0001.png", photo, turns)
        write(folder / "masks" / "0001.png", mask)
        (view,) = (view for view in read_capture(folder).views if view.camera.name == "0001")
        return load_view(view, 40)

    upright, sideways = nerfstudio(tmp_path / "upright"), nerfstudio(tmp_path / "sideways")
    edit(upright / "transforms.json", lambda data: data["frames"][1].update(own))
    pose = np.array(json.loads((upright / "transforms.json").read_text())["frames"][1]["transform_matrix"])
    if as_stored:
        for _ in range(turns):  # counter-clockwise: what was up is at the left, what was right is up
            pose = pose @ np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
            own = {
                "w": own["h"], "h": own["w"], "fl_x": own["fl_y"], "fl_y": own["fl_x"],
                "cx": own["cy"], "cy": own["w"] - own["cx"], "k1": own["k1"], "p1": -own["p2"], "p2": own["p1"],
            }  # fmt: skip
    edit(sideways / "transforms.json", lambda data: data["frames"][1].update(own, transform_matrix=pose.tolist()))
    expected = loaded(upright, 0, mask)
    for drawn in (mask,) if turns == 2 else (mask, np.rot90(mask, turns)):
        found = loaded(sideways, turns, drawn)
        np.testing.assert_allclose(found.camera.projection, expected.camera.projection, atol=1e-9)
        np.testing.assert_allclose(found.image.astype(int), expected.image, atol=1)
        np.testing.assert_allclose(found.alpha.astype(int), expected.alpha, atol=1)


@pytest.mark.parametrize("orientation", [2, 4, 5, 7])
def test_mirrored_photos_stay_as_they_are_stored(tmp_path, orientation):
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    Image.fromarray(smooth(48, 64)).save(tmp_path / "a.png", exif=exif)
    assert np.array_equal(read_image(tmp_path / "a.png")[0], smooth(48, 64))


def test_a_capture_of_heic_photos(tmp_path):
    folder = nerfstudio(tmp_path)
    for path in (folder / "images").iterdir():
        write_as_phone(path.with_suffix(".HEIC"), read_image(path)[0])
        path.unlink()
    (folder / "transforms.json").write_text((folder / "transforms.json").read_text().replace(".png", ".HEIC"))
    capture = read_capture(folder)
    assert len(capture.views) == 16 and {view.camera.name for view in capture.views} >= {"0000", "0015"}
    assert load_view(capture.views[0]).image[24, 32].max() > 150  # the ball


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({"FocalLengthIn35mmFilm": 26}, 26 / 43.267 * 800),
        ({"FocalLength": 5.0, "FocalPlaneXResolution": 2540.0, "FocalPlaneResolutionUnit": 2}, 5 * 100 / 2),
        ({"FocalLength": 5.0}, None),  # of which sensor?
        ({"FocalLengthIn35mmFilm": 0}, None),
    ],
)
def test_focal_length_by_exif(tmp_path, tags, expected):
    exif = Image.Exif()
    tags = {**tags, "ExifImageWidth": 1280, "ExifImageHeight": 960}  # halved since
    exif.get_ifd(ExifTags.IFD.Exif).update({ExifTags.Base[name]: value for name, value in tags.items()})
    Image.new("RGB", (640, 480)).save(tmp_path / "a.jpg", exif=exif)
    assert read_focal_length(tmp_path / "a.jpg") == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("masked", [True, False])
def test_large_jpegs_are_reduced_by_their_decoder(tmp_path, masked):
    """Check that the decoder reduces a JPEG whose sides divide, with the same result as reducing a PNG, and its camera and lens."""
    folder, photo, jpeg, png = nerfstudio(tmp_path), smooth(960, 1280), tmp_path / "images/a.jpg", tmp_path / "a.png"
    write_as_phone(jpeg, photo)
    write(png, photo)
    if masked:
        write(folder / "masks" / "a.png", np.tri(960, 1280, dtype=np.uint8) * 255)
    own = {"w": 1280, "h": 960, "fl_x": 1200.0, "fl_y": 1200.0, "cx": 630.0, "cy": 490.0, "k1": -0.1, "p1": 0.01}
    edit(folder / "transforms.json", lambda data: data["frames"][1].update(own, file_path="images/a.jpg"))
    assert read_image(jpeg, 4)[0].shape == (240, 320, 3)
    (view,) = (view for view in read_capture(folder).views if view.image_path == jpeg)
    jpg, png = load_view(view, 160), load_view(replace(view, image_path=png), 160)
    visible = slice(None) if png.alpha is None else png.alpha > 20
    difference = np.abs(jpg.image.astype(int) - png.image)[visible]
    assert difference.mean() < 1 and difference.max() < 6
    assert not masked or np.abs(jpg.alpha.astype(int) - png.alpha).max() <= 16  # undistortion blurs its edge
    write_as_phone(jpeg, photo[:-2])
    assert read_image(jpeg, 4)[0].shape == (479, 640, 3)
    write_as_phone(jpeg, photo[:-1])
    assert read_image(jpeg, 4)[0].shape == (959, 1280, 3)  # a quarter would be no exact one
    jpeg.write_bytes(jpeg.read_bytes()[:-2000])
    with pytest.raises(InputError, match="truncated"):
        read_image(jpeg, 4)


def test_downsizing_averages_linear_light_and_does_not_bleed(tmp_path):
    folder = nerf_blender(tmp_path)
    image = np.zeros((48, 64, 4), np.uint8)
    image[:, ::2, :3] = 255  # columns of white and black, opaque on the left
    image[:, :33, 3] = 255
    image[:, 33:, :3] = (255, 0, 255)  # a garish colour where it is transparent
    write(folder / "train" / "r_0.png", image)
    view = next(view for view in read_capture(folder).train_views if view.camera.name == "r_0")
    loaded = load_view(view, 32)
    assert loaded.image.shape == (24, 32, 3) and (loaded.camera.width, loaded.camera.height) == (32, 24)
    assert loaded.camera.fx == pytest.approx(view.camera.fx / 2)
    np.testing.assert_array_equal(loaded.image[:, :16], 188)  # sRGB of half the light
    np.testing.assert_array_equal(loaded.image[:, 16], 255)  # half covered, its opaque half white
    assert abs(int(loaded.alpha[0, 16]) - 128) <= 1
    assert not loaded.image[:, 17:].any() and not loaded.alpha[:, 17:].any()


def test_full_size_is_returned_as_stored(tmp_path):
    view = read_capture(nerf_blender(tmp_path)).views[0]
    loaded = load_view(view, None)
    stored = cv2.imread(str(view.image_path), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(loaded.image, stored[..., 2::-1]) and np.array_equal(loaded.alpha, stored[..., 3])


def distorted_dots(width, height, matrix, coefficients):
    """Draw dots through OpenCV's lens distortion. Returns the photo (height, width, 3) and the dots' undistorted rays (n, 3)."""
    rays = np.stack([*np.meshgrid(np.linspace(-0.5, 0.5, 5), np.linspace(-0.4, 0.4, 4)), np.ones((4, 5))], -1)
    rays = rays.reshape(-1, 3)
    pixels = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]
    v, u = np.mgrid[:height, :width] + 0.5
    distance = np.hypot(u[..., None] - pixels[:, 0], v[..., None] - pixels[:, 1]).min(axis=-1)
    return np.rint(255 * np.exp(-0.5 * (distance / 3) ** 2)).astype(np.uint8)[..., None].repeat(3, axis=2), rays


@pytest.mark.parametrize("k1", [-0.25, 0.2])
@pytest.mark.parametrize("side", [None, 160])
def test_undistortion_against_opencv(tmp_path, k1, side):
    """Check that undistortion moves dots, drawn by OpenCV's projectPoints, to where a pinhole camera sees them."""
    width, height, fx, fy, cx, cy = 320, 240, 290.0, 300.0, 155.0, 124.0
    coefficients = np.array([k1, 0.05, 0.004, -0.003, 0.02])  # k1 k2 p1 p2 k3
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    image, rays = distorted_dots(width, height, matrix, coefficients)
    folder = nerfstudio(tmp_path)
    write(folder / "images" / "0001.png", image)
    lens = dict(zip(("k1", "k2", "p1", "p2", "k3"), coefficients.tolist(), strict=True))
    own = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": width, "h": height, **lens}
    edit(folder / "transforms.json", lambda data: data["frames"][1].update(own))
    view = next(view for view in read_capture(folder).views if view.camera.name == "0001")
    loaded = load_view(view, side)
    camera = loaded.camera
    assert camera.fx / camera.fy == pytest.approx(fx / fy)
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    found = 0
    for x, y, _ in rays:
        expected = np.array([camera.fx * x + camera.cx, camera.fy * y + camera.cy])
        if not (6 < expected[0] < camera.width - 6 and 6 < expected[1] < camera.height - 6):
            continue
        weight = loaded.image[..., 0] * (np.hypot(u - expected[0], v - expected[1]) < 5.0)
        centroid = np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()
        assert np.linalg.norm(centroid - expected) < 0.15
        found += 1
    assert found >= 6


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize(
    ("model", "opencv"),
    [
        ((0, "SIMPLE_PINHOLE", [60.0, 32.0, 24.0]), None),
        ((2, "SIMPLE_RADIAL", [60.0, 32.0, 24.0, -0.1]), [60.0, 60.0, 32.0, 24.0, -0.1, 0.0, 0.0, 0.0]),
        ((3, "RADIAL", [60.0, 32.0, 24.0, 0.1, 0.02]), [60.0, 60.0, 32.0, 24.0, 0.1, 0.02, 0.0, 0.0]),
        (OPENCV, OPENCV[2]),
    ],
)
def test_colmap_models_leave_no_invalid_pixels(tmp_path, model, opencv, binary):
    """Check that an undistorted white photo is white to its corners, and that its pixels come from where OpenCV's model says."""
    folder = colmap(tmp_path, binary, model)
    for path in (folder / "images").iterdir():
        write(path, np.full((48, 64, 3), 255, np.uint8))
    view = read_capture(folder).views[0]
    assert load_view(view, None).image.min() == 255
    if opencv is None:
        assert view.lens is None
        return
    across, down = view.lens.maps(view.camera)
    assert across.min() >= -0.51 and across.max() <= 63.51 and down.min() >= -0.51 and down.max() <= 47.51
    # As little as possible is lost: the map reaches the photo's border somewhere.
    slack = min(across.min() + 0.5, 63.5 - across.max(), down.min() + 0.5, 47.5 - down.max())
    assert slack < 1.0
    fx, fy, cx, cy, *coefficients = opencv
    camera = view.camera
    ray = np.array([[(3.5 - camera.cx) / camera.fx, (40.5 - camera.cy) / camera.fy, 1.0]])
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    expected = cv2.projectPoints(ray, np.zeros(3), np.zeros(3), matrix, np.array(coefficients))[0][0, 0]
    np.testing.assert_allclose([across[40, 3] + 0.5, down[40, 3] + 0.5], expected, atol=1e-4)


def test_masks_are_undistorted_with_their_photo(tmp_path):
    folder = colmap(tmp_path, model=OPENCV)
    for path in (folder / "images").iterdir():
        image = cv2.imread(str(path))
        write(folder / "masks" / path.name, np.where(image.max(axis=2) > 0, 255, 0).astype(np.uint8))
    view = read_capture(folder).views[0]
    loaded = load_view(view, None)
    plain = load_view(replace(view, lens=None), None)
    inside = loaded.alpha > 250
    assert (loaded.image[inside].max(axis=1) > 150).all()
    assert not loaded.image[loaded.alpha == 0].any()
    assert (loaded.alpha != plain.alpha).any()


def check_codes(path, image, white, alpha=None):
    """Check that a photo's 16-bit codes come into the training as they are, and that other users get 8-bit ones."""
    camera = Camera("a", *image.shape[1::-1], 60, 60, 32, 24, np.eye(4))
    loaded = load_view(View(camera, path, None, "train", None, alpha is not None, None))
    assert loaded.image.dtype == np.uint16 and loaded.white == white
    np.testing.assert_array_equal(loaded.image, image)
    np.testing.assert_allclose(loaded.encoded, image / np.float64(white), rtol=1e-6)
    assert loaded.bytes.dtype == np.uint8
    np.testing.assert_allclose(loaded.bytes, np.minimum(image / white, 1) * 255, atol=0.5001)
    if alpha is not None:
        np.testing.assert_array_equal(loaded.alpha, alpha)
    return loaded


@pytest.mark.parametrize("turns", range(4))
@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_16_bits_are_kept_in_training(tmp_path, suffix, channels, turns):
    values = np.random.default_rng(0).integers(0, 65536, (48, 64, channels)).astype(np.uint16)
    path, stored = tmp_path / f"ö{suffix}", np.ascontiguousarray(np.rot90(values, turns))
    if suffix == ".tif":
        orientation = (274, "H", 1, (1, 6, 3, 8)[turns], False)
        options = {"extrasamples": [2]} if channels == 4 else {}
        kind = "minisblack" if channels == 1 else "rgb"
        tifffile.imwrite(path, np.squeeze(stored), photometric=kind, metadata=None, extratags=[orientation], **options)
    else:
        write(path, np.squeeze(stored))
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = (1, 6, 3, 8)[turns]
        chunk = b"eXIf" + exif.tobytes().removeprefix(b"Exif\0\0")
        data = path.read_bytes()
        added = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
        path.write_bytes(data[:33] + added + data[33:])  # behind the first chunk
    alpha = np.rint(values[..., 3] / 257) if channels == 4 else None
    colors = values[..., :3] if channels > 1 else np.repeat(values, 3, axis=2)
    assert read_header(path).upright == (64, 48)
    check_codes(path, colors, 65535, alpha)
    assert np.abs(read_image(path)[0] - colors / 257.0).max() < 1


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("packed", [None, "deflate"])
def test_tiff_of_every_kind_with_16_bits(tmp_path, order, packed):
    """Check planes, white at 0, premultiplied alpha and a fourth channel that is no alpha."""
    values, path = np.random.default_rng(0).integers(0, 65536, (48, 64, 4)).astype(np.uint16), tmp_path / "a.tif"
    rgb, alpha = values[..., :3], np.rint(values[..., 3] / 257)

    def save(stored, kind, **options):
        options |= {"byteorder": order, "compression": packed, "metadata": None}
        tifffile.imwrite(path, np.ascontiguousarray(stored), photometric=kind, **options)

    def planes(stored):
        return np.moveaxis(stored, -1, 0)

    save(planes(rgb), "rgb", planarconfig="separate")
    check_codes(path, rgb, 65535)
    save(planes(np.rot90(rgb)), "rgb", planarconfig="separate", extratags=[(274, "H", 1, 6, False)])
    check_codes(path, rgb, 65535)
    save(planes(values), "rgb", planarconfig="separate", extrasamples=[2])
    check_codes(path, rgb, 65535, alpha)
    save(values[..., 0], "miniswhite")
    check_codes(path, 65535 - values[..., [0, 0, 0]], 65535)
    straight = np.rint(np.minimum(rgb / np.maximum(values[..., 3:], 1) * 65535, 65535))
    for stored, options in ((values, {}), (planes(values), {"planarconfig": "separate"})):
        save(stored, "rgb", extrasamples=[1], **options)
        image, found, _ = read_codes(path)
        assert np.abs(image - straight).max() <= 1 and np.array_equal(found, alpha)
    save(values, "rgb", extrasamples=[0])
    image, found, _ = read_codes(path)
    assert np.array_equal(image, rgb) and found is None and not read_header(path).has_alpha


def test_tiff_with_8_bits_of_other_kinds(tmp_path):
    """Check white at 0 and premultiplied grey."""
    values, path = np.random.default_rng(0).integers(0, 256, (48, 64, 2)).astype(np.uint8), tmp_path / "a.tif"
    tifffile.imwrite(path, values[..., 0], photometric="miniswhite", metadata=None)
    assert np.array_equal(read_image(path)[0][..., 1], 255 - values[..., 0])
    options = {"extrasamples": [1], "planarconfig": "contig"}
    tifffile.imwrite(path, values, photometric="minisblack", metadata=None, **options)
    image, alpha = read_image(path)
    straight = np.minimum(values[..., 0] * 255.0 / np.maximum(values[..., 1], 1), 255)
    assert np.abs(image[..., 2] - straight).max() <= 0.5 and np.array_equal(alpha, values[..., 1])


def test_the_first_of_many_pages_is_read(tmp_path):
    pages = np.random.default_rng(0).integers(0, 65536, (5, 48, 64, 3)).astype(np.uint16)
    for dtype in (np.uint8, np.uint16):
        tifffile.imwrite(tmp_path / "a.tif", pages.astype(dtype), photometric="rgb", metadata=None)
        assert np.array_equal(read_codes(tmp_path / "a.tif")[0], pages[0].astype(dtype))


def test_8_bits_stay_8_bits(tmp_path):
    values = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    for suffix in (".png", ".tif", ".bmp"):
        write(tmp_path / f"a{suffix}", values)
        view = View(
            Camera("a", 64, 48, 60, 60, 32, 24, np.eye(4)), tmp_path / f"a{suffix}", None, "train", None, False, None
        )
        loaded = load_view(view)
        assert loaded.image.dtype == np.uint8 and loaded.white == 255
        np.testing.assert_array_equal(loaded.image, values)
        assert load_view(view, 32).image.dtype == np.uint8


@pytest.mark.parametrize("name", ["a.png", "a.tif", "planes.tif", "a.heic"])
def test_truncated_16_bit_photos_are_refused(tmp_path, name):
    path = tmp_path / name
    codes = np.random.default_rng(0).integers(0, 65536, (48, 64, 3)).astype(np.uint16)
    if name == "planes.tif":
        planes = np.ascontiguousarray(np.moveaxis(codes, -1, 0))
        tifffile.imwrite(path, planes, photometric="rgb", planarconfig="separate", metadata=None)
    elif name == "a.heic":
        pillow_heif.from_bytes(mode="RGB;16", size=(64, 48), data=codes.tobytes()).save(path)
    else:
        write(path, codes)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    view = View(Camera("a", 64, 48, 60, 60, 32, 24, np.eye(4)), path, None, "train", None, False, None)
    with pytest.raises(InputError, match=name):
        load_view(view)


@pytest.mark.parametrize("turns", range(4))
@pytest.mark.parametrize("side", [None, 16])
def test_raw_is_linear_radiance_with_the_cameras_white_balance(tmp_path, side, turns):
    linear = np.full((48, 64, 3), (0.2, 0.4, 0.1))
    linear[:24] = 0.5, 0.25, 0.3
    linear[:, 32:] /= 8
    write_dng(tmp_path / "ö.DNG", linear, (0.5, 1, 0.7), turns, film=26)
    header = read_header(tmp_path / "ö.DNG")
    assert header.upright == (64, 48) and header[:2] == ((64, 48), (48, 64))[turns % 2]
    assert read_focal_length(tmp_path / "ö.DNG") == pytest.approx(26 / 43.267 * 80, rel=1e-4)
    view = View(Camera("a", 64, 48, 60, 60, 32, 24, np.eye(4)), tmp_path / "ö.DNG", None, "train", None, False, None)
    loaded = load_view(view, side)
    found, true = srgb_decode(loaded.encoded), linear if side is None else linear[::4, ::4]
    ends = 8 if side is None else 2  # pixels beside an edge are interpolated
    flat = np.zeros(true.shape[:2], bool)
    for half in (slice(ends, true.shape[0] // 2 - ends), slice(true.shape[0] // 2 + ends, -ends)):
        flat[half, ends : true.shape[1] // 2 - ends] = flat[half, true.shape[1] // 2 + ends : -ends] = True
    assert flat.sum() > 20
    # The darkest value is 13 of 16,383 levels a hundredth.
    np.testing.assert_allclose(found[flat], true[flat], rtol=0.01)


def test_raw_of_all_exposures_has_one_scale(tmp_path):
    """Check that a dark photo stays dark: LibRaw by itself would stretch it to white."""
    write_dng(tmp_path / "dark.dng", np.full((48, 64, 3), 0.03))
    view = View(Camera("a", 64, 48, 60, 60, 32, 24, np.eye(4)), tmp_path / "dark.dng", None, "train", None, False, None)
    np.testing.assert_allclose(srgb_decode(load_view(view).encoded), 0.03, rtol=0.01)


def test_raw_is_clipped_where_the_sensor_is_saturated(tmp_path):
    linear = np.full((48, 64, 3), 0.3)
    linear[:, 32:] = 3.0
    linear[:, 48:] *= 0.3, 0.1, 0.1  # red alone saturates
    write_dng(tmp_path / "a.dng", linear, (1, 1, 1))
    view = View(Camera("a", 64, 48, 60, 60, 32, 24, np.eye(4)), tmp_path / "a.dng", None, "train", None, False, None)
    image = load_view(view).image
    assert image[:, :24].max() < 65535 and (image[:, 36:44] == 65535).all()
    assert image[:, 52:, 1:].max() < 65535


def test_raw_that_cannot_be_read(tmp_path):
    write_dng(tmp_path / "whole.dng", np.full((480, 640, 3), 0.3))
    data = (tmp_path / "whole.dng").read_bytes()
    for name, content, says in (
        ("other.cr3", b"something else" * 100, "does not know this camera's RAW"),
        ("empty.nef", b"", "broken"),
        ("cut.dng", data[: len(data) // 2], "truncated or broken"),
        ("type.dng", data[:76] + b"\x43" + data[77:], "too little memory"),  # a field of TIFF of an unknown type
    ):
        (tmp_path / name).write_bytes(content)
        view = View(
            Camera("a", 640, 480, 60, 60, 320, 240, np.eye(4)), tmp_path / name, None, "train", None, False, None
        )
        for read in (lambda view=view: load_view(view), lambda path=tmp_path / name: read_image(path)):
            with pytest.raises(InputError, match=name.replace(".", r"\.")) as error:
                read()
            assert says in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(InputError, match="missing"):
        read_header(tmp_path / "none.dng")


@pytest.mark.parametrize("channels", ["Y", "RGB", "RGBA"])
def test_exr_is_linear_radiance_without_an_end(tmp_path, channels):
    rng = np.random.default_rng(0)
    linear = np.exp(rng.uniform(np.log(0.001), np.log(500), (48, 64, 3))).astype(np.float32)
    alpha = rng.integers(1, 256, (48, 64)).astype(np.float32) / 255 if channels == "RGBA" else None
    if alpha is not None:
        alpha[:4] = 0
    pixels = {"Y": linear[..., 0], "RGB": linear, "RGBA": np.dstack([linear, np.ones((48, 64), np.float32)])}[channels]
    write_exr(tmp_path / "a.exr", pixels if alpha is None else pixels * alpha[..., None])
    assert read_header(tmp_path / "a.exr") == (64, 48, channels == "RGBA", 0)
    assert read_focal_length(tmp_path / "a.exr") is None
    camera = Camera("a", 64, 48, 60, 60, 32, 24, np.eye(4))
    loaded = load_view(View(camera, tmp_path / "a.exr", None, "train", None, channels == "RGBA", None))
    true = np.repeat(linear[..., :1], 3, axis=2) if channels == "Y" else linear
    seen = np.ones((48, 64), bool) if alpha is None else alpha > 0
    np.testing.assert_allclose(srgb_decode(loaded.encoded)[seen], true[seen], rtol=0.01, atol=1e-5)
    assert not loaded.clipped.any() and loaded.bytes.max() == 255
    if alpha is not None:
        np.testing.assert_array_equal(loaded.alpha, np.rint(alpha * 255))
    small = load_view(View(camera, tmp_path / "a.exr", None, "train", None, False, None), 16)
    blocks = true.reshape(12, 4, 16, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(srgb_decode(small.encoded)[1:], blocks[1:], rtol=0.01)


def test_exr_with_odd_values(tmp_path):
    """Check that what is not a number or negative is black, and that what is brighter than any code is clipped."""
    values = np.full((48, 64, 3), 0.5, np.float32)
    values[0, :4] = [[np.nan] * 3, [-1] * 3, [np.inf] * 3, [1000] * 3]
    write_exr(tmp_path / "a.exr", values)
    view = View(Camera("a", 64, 48, 60, 60, 32, 24, np.eye(4)), tmp_path / "a.exr", None, "train", None, False, None)
    loaded = load_view(view)
    assert not loaded.image[0, :2].any() and (loaded.image[0, 2:4] == 65535).all() and loaded.clipped.sum() == 6


def test_exr_that_cannot_be_read(tmp_path):
    write_exr(tmp_path / "whole.exr", np.random.default_rng(0).uniform(size=(48, 64, 3)))
    data = (tmp_path / "whole.exr").read_bytes()
    (tmp_path / "cut.exr").write_bytes(data[: len(data) // 2])
    header = {"dataWindow": ((2, 0), (5, 3)), "displayWindow": ((0, 0), (7, 7))}
    OpenEXR.File(header, {"RGB": np.ones((4, 4, 3), np.float32)}).write(str(tmp_path / "part.exr"))
    for name, says in (("cut.exr", "whole"), ("part.exr", "crop"), ("none.exr", "missing")):
        with pytest.raises(InputError, match=name) as error:
            read_header(tmp_path / name), read_image(tmp_path / name)
        assert says in str(error.value) and "\n" not in str(error.value)


def test_photos_for_colmap(tmp_path):
    """Check that COLMAP gets RAW and EXR as JPEG, as they are stored, and 16-bit PNG as it is."""
    upright = srgb_decode(smooth(48, 64) / 255)
    write_dng(tmp_path / "a.dng", upright, turns=1)
    write_exr(tmp_path / "a.exr", upright)
    write(tmp_path / "a.png", smooth(48, 64).astype(np.uint16) * 257)
    for name, turns in (("a.dng", 1), ("a.exr", 0)):
        assert write_for_colmap(tmp_path / name, tmp_path / "out.jpg")
        stored = np.asarray(Image.open(tmp_path / "out.jpg")).astype(int)
        assert np.abs(np.rot90(stored, -turns) - smooth(48, 64)).mean() < 8
    assert not write_for_colmap(tmp_path / "a.png", tmp_path / "b.jpg") and not (tmp_path / "b.jpg").exists()


def test_photos_that_are_there_as_raw_and_jpeg(tmp_path):
    for name in ("a.dng", "a.JPG", "b.CR3", "c.exr", "c.png", "d.exr"):
        (tmp_path / name).touch()
    assert [path.name for path in find_photos(tmp_path)] == ["a.JPG", "b.CR3", "c.png", "d.exr"]


@pytest.mark.parametrize("suffix", [".dng", ".exr", ".png"])
def test_a_capture_of_photos_with_more_than_8_bits(tmp_path, suffix):
    """Check that such a capture is read and checked like one of 8-bit photos."""
    folder = nerfstudio(tmp_path / "capture", 8)
    for path in sorted((folder / "images").iterdir()):
        photo = read_image(path)[0]
        path.unlink()
        if suffix == ".png":
            write(path, photo.astype(np.uint16) * 257)
        else:
            (write_dng if suffix == ".dng" else write_exr)(path.with_suffix(suffix), srgb_decode(photo / 255))
    edit(
        folder / "transforms.json",
        lambda data: [f.update(file_path=f["file_path"].replace(".png", suffix)) for f in data["frames"]],
    )
    capture = read_capture(folder)
    assert {view.camera.name for view in capture.views} == {f"{i:04d}" for i in range(8)}
    facts = check(capture, tmp_path / "out")
    assert all(Image.open(path).mode == "RGB" for path in facts["thumbnails"])
    assert not [line for line in facts["lines"] if any(word in line for word in ("greyscale", "clipped", "EXR"))]


@pytest.mark.parametrize(("factor", "said"), [(1e-4, "almost black"), (1e3, "almost white")])
def test_exr_photos_in_another_unit(tmp_path, factor, said):
    folder = nerfstudio(tmp_path / "capture", 8)
    for path in sorted((folder / "images").iterdir()):
        write_exr(path.with_suffix(".exr"), factor * (0.1 + srgb_decode(read_image(path)[0] / 255)))
        path.unlink()
    text = (folder / "transforms.json").read_text().replace(".png", ".exr")
    (folder / "transforms.json").write_text(text)
    (line,) = (line for line in check(read_capture(folder), tmp_path / "out")["lines"] if "EXR" in line)
    assert said in line and "factor" in line


@pytest.mark.parametrize("name", gain_maps.WITH)
def test_the_standard_picture_of_a_photo_with_a_gain_map_is_read(tmp_path, name):
    gain_maps.WITH[name](tmp_path / name)
    assert has_gain_map(tmp_path / name)
    assert read_header(tmp_path / name)[:2] == (gain_maps.WIDTH, gain_maps.HEIGHT)
    image, alpha = read_image(tmp_path / name)
    assert image.shape == (gain_maps.HEIGHT, gain_maps.WIDTH, 3) and alpha is None
    # JPEGs have a profile: these codes of Display P3 are those of sRGB.
    expected = (216, 93, 24) if name.endswith(".jpg") else gain_maps.CODE
    np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), atol=3)
    small = read_image(tmp_path / name, shrink=4)[0]
    assert small.shape[0] in (gain_maps.HEIGHT // 4, gain_maps.HEIGHT) and np.ptp(small, axis=(0, 1)).max() <= 2


@pytest.mark.parametrize("name", gain_maps.WITHOUT)
def test_photos_without_a_gain_map(tmp_path, name):
    gain_maps.WITHOUT[name](tmp_path / name)
    assert not has_gain_map(tmp_path / name)


def test_a_broken_second_picture_hides_no_photo(tmp_path):
    gain_maps.WITH["ISO 21496-1.jpg"](tmp_path / "a.jpg")
    data = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "a.jpg").write_bytes(data[: data.rindex(b"\xff\xd8\xff") + 8])
    assert not has_gain_map(tmp_path / "a.jpg") and read_image(tmp_path / "a.jpg")[0].shape == (48, 64, 3)
