"""Test the loading of photos: broken files are refused; masks, undistortion and resizing add no colours of their own."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from refgs.capture import load_view, read_capture
from refgs.capture.images import read_focal_length, read_header, read_image
from refgs.errors import InputError
from tests.makers.captures import colmap, edit, nerf_blender, nerfstudio, write, write_as_phone

OPENCV = (4, "OPENCV", [60.0, 61.0, 31.0, 25.0, -0.2, 0.05, 0.003, -0.002])


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
