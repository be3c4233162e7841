"""Test what prepares a capture in Blender, with a fake trainer: photos from a video, masks, and strokes that correct masks."""

import json
from pathlib import Path

import bpy
import cv2
import numpy as np
import pytest
from PIL import Image

from refgs_addon import jobs
from refgs_addon.errors import InputError
from refgs_addon.scene.capture_cameras import cameras_of, show_cameras
from refgs_addon.trainer import preferences
from refgs_addon.trainer.scene import strokes, training, training_box
from refgs_addon.trainer.ui.train_panel import status_words
from tests.makers.waiting import final_state, until

pytestmark = pytest.mark.usefixtures("fake_trainer")

WIDTH, HEIGHT = 64, 48


@pytest.fixture
def capture(addon, tmp_path):
    """Make a capture of the fake trainer's two photos, and choose it."""
    folder = tmp_path / "good photos"
    (folder / "images").mkdir(parents=True)
    addon.refgs.capture = f"{folder}/"
    return folder


def asked(folder):
    """Read with what the fake trainer was asked to make masks."""
    return json.loads((folder / "asked").read_text())


def add_photo(scene, folder, name, pixels=None, **saved):
    """Add a camera with a photo in `folder`/images. Returns the camera."""
    pixels = np.full((HEIGHT, WIDTH, 3), 128, np.uint8) if pixels is None else pixels
    Image.fromarray(pixels).save(folder / "images" / name, **saved)
    camera = bpy.data.objects.new(name, bpy.data.cameras.new(name))
    camera.data["refgs_photo"], camera.data["refgs_size"] = str(folder / "images" / name), [WIDTH, HEIGHT]
    scene.collection.objects.link(camera)
    return camera


def pixels_of(image):
    """Read an image's pixels, top row first."""
    values = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(image.size[1], image.size[0], 4)[::-1]


def paint(canvas, rows, columns, color):
    values = pixels_of(canvas).copy()
    values[rows, columns] = color
    canvas.pixels.foreach_set(values[::-1].ravel())


def test_a_video_becomes_the_capture(addon, tmp_path):
    film = tmp_path / "film.mp4"
    film.touch()
    (tmp_path / "film").mkdir()
    assert bpy.ops.refgs.photos_from_video(filepath=str(film), count=37) == {"FINISHED"}
    job = jobs.JOBS[-1]
    assert not addon.refgs.capture  # until the photos are there
    until(lambda: job.progress)
    assert final_state(job) == "done" and job.results["frames"]["photos"] == 37
    assert status_words(job) == "2 frames read, 2 kept, 1 blurred"
    assert addon.refgs.capture == str(tmp_path / "film 2") and (tmp_path / "film 2" / "images").is_dir()
    with pytest.raises(RuntimeError, match="images exists: choose another folder"):
        bpy.ops.refgs.photos_from_video(filepath=str(film), out=str(tmp_path / "film 2"))
    with pytest.raises(RuntimeError, match=r"none\.mp4 is not a file"):
        bpy.ops.refgs.photos_from_video(filepath=str(tmp_path / "none.mp4"))


def test_a_video_is_cancelled(addon, tmp_path):
    (tmp_path / "slow.mov").touch()
    bpy.ops.refgs.photos_from_video(filepath=str(tmp_path / "slow.mov"))
    job = jobs.JOBS[-1]
    until(lambda: job.progress)
    bpy.ops.refgs.tell(serial=job.serial, command="cancel")
    assert final_state(job) == "cancelled" and not addon.refgs.capture and not (tmp_path / "slow").exists()


def test_another_file_is_left_alone(addon, tmp_path):
    """Check that a job that ends after another file was opened does not choose the capture there."""
    (tmp_path / "film.mp4").touch()
    job = training.extract_photos(addon, tmp_path / "film.mp4", None, 10)
    bpy.ops.wm.read_homefile(use_empty=True)
    assert final_state(job) == "done" and not bpy.context.scene.refgs.capture


def test_masks_show_the_box_among_the_cameras(addon, capture):
    assert bpy.ops.refgs.make_masks() == {"FINISHED"}
    job = jobs.JOBS[-1]
    with pytest.raises(RuntimeError, match="are being made already"):
        bpy.ops.refgs.make_masks()
    assert final_state(job) == "done" and asked(capture) == {"settings": [], "model": None}
    assert [item.name for item in cameras_of(addon, capture).objects] == ["0", "1"]
    # The box is in the frame of the masked capture already, and has room.
    box = training_box.training_region(addon)
    settings = training_box.region_settings(addon)
    assert settings["region.centre"] == pytest.approx([1, 0, 0])
    assert settings["region.size"] == pytest.approx([training_box.ROOM * edge for edge in (1, 2, 4)])
    # As long as nobody touches it, it does not limit masks: strokes may add what is outside.
    assert training_box.artists_region(addon) is None
    assert final_state(training.make_masks(addon)) == "done" and asked(capture) == {"settings": [], "model": None}
    assert sum("masks" in job.results for job in jobs.JOBS) == 1
    box.location = 1, 2, 3
    assert training_box.artists_region(addon) == box
    preferences.preferences().mask_model = "/models/birefnet.onnx"
    assert final_state(training.make_masks(addon)) == "done"
    assert asked(capture)["model"] == "/models/birefnet.onnx"
    sent = asked(capture)["settings"]
    assert [word.split("=")[0] for word in sent] == ["region.centre", "region.size", "region.rotation"]
    assert json.loads(sent[0].split("=")[1]) == [1, 2, 3]
    # The masks changed the frame, and the box with it.
    assert training_box.region_settings(addon)["region.centre"] == pytest.approx([2, 4, 7])


def test_a_training_that_makes_masks_moves_the_frame(addon, tmp_path):
    folder = tmp_path / "unmasked photos"
    (folder / "images").mkdir(parents=True)
    addon.refgs.capture, addon.refgs.mesh = f"{folder}/", False
    checked = training.check(addon)
    assert final_state(checked) == "done"
    found = checked.results["check"]
    shown = show_cameras(addon, Path(found["capture"]), Path(found["cameras"]))
    before = [camera.location.copy() for camera in shown.objects]
    box = training_box.add_training_region(addon)
    box.location = 1, 2, 3
    job = training.train(addon)
    until(lambda: job.curve)
    assert job.decided["masks"] == "made 3 masks"
    assert training_box.region_settings(addon)["region.centre"] == pytest.approx([2, 4, 7])
    for old, camera in zip(before, shown.objects, strict=True):
        assert list(camera.location) == pytest.approx([2 * old[0], 2 * old[1], 2 * old[2] + 1])
    job.stop()
    assert final_state(job) == "cancelled"


def test_strokes_are_painted_saved_and_seen(addon, capture):
    white = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    addon.camera = add_photo(addon, capture, "a.png", white)
    other = add_photo(addon, capture, "b.jpg")
    assert bpy.ops.refgs.paint_strokes() == {"FINISHED"}
    (canvas,) = strokes.canvases()
    bpy.context.view_layer.objects.active = other
    bpy.ops.refgs.paint_strokes()
    assert len(strokes.canvases()) == 2
    with pytest.raises(RuntimeError, match="nothing was painted"):
        bpy.ops.refgs.save_strokes()
    assert not (capture / "strokes").exists()
    paint(canvas, slice(4, 8), slice(10, 20), (1, 1, 1, 1))  # a stroke on what is white in the photo
    paint(canvas, slice(30, 40), slice(0, 5), (0, 0, 0, 1))
    paint(canvas, slice(10, 12), slice(10, 12), (1, 1, 1, 0))  # erased
    assert bpy.ops.refgs.save_strokes() == {"FINISHED"}
    written = cv2.imread(str(capture / "strokes" / "a.png"), cv2.IMREAD_UNCHANGED)
    expected = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    expected[4:8, 10:20], expected[30:40, 0:5, 3] = 255, 255
    np.testing.assert_array_equal(written, expected)
    assert [file.name for file in (capture / "strokes").iterdir()] == ["a.png"]
    # The new mask is seen, and what was painted meanwhile stays.
    paint(canvas, slice(20, 24), slice(50, 60), (1, 1, 1, 1))
    (capture / "masks").mkdir()
    cv2.imwrite(
        str(capture / "masks" / "a.png"), np.repeat([0, 255], WIDTH // 2)[None].repeat(HEIGHT, 0).astype(np.uint8)
    )
    assert final_state(jobs.JOBS[-1]) == "done"
    shown = pixels_of(canvas)
    assert shown[20:24, 50:60].min() == shown[4:8, 10:20].min() == 1 and shown[30:40, 0:5, :3].max() == 0
    assert shown[45, 5] == pytest.approx((0.77, 0.44, 0.47, 1), abs=0.01)
    assert shown[45, 50] == pytest.approx((0.8, 0.8, 0.8, 1), abs=0.01)
    # A new canvas begins with the strokes that were saved.
    bpy.data.images.remove(canvas)
    bpy.context.view_layer.objects.active = addon.camera
    bpy.ops.refgs.paint_strokes()
    shown = pixels_of(next(canvas for canvas in strokes.canvases() if canvas["refgs_photo"].endswith("a.png")))
    assert shown[4:8, 10:20].min() == 1 and shown[20:24, 50:60, 1].max() < 0.9
    # Strokes that were all erased leave a file that says nothing.
    for canvas in strokes.canvases():
        paint(canvas, slice(None), slice(None), (1, 1, 1, 0))
    assert strokes.save(capture) == [capture / "strokes" / "a.png"]
    assert not cv2.imread(str(capture / "strokes" / "a.png"), cv2.IMREAD_UNCHANGED).any()


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_canvas_is_upright(addon, capture, orientation):
    stored = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    stored[: HEIGHT // 2, : WIDTH // 2] = 255
    exif = Image.Exif()
    exif[0x010F], exif[0x0112] = "maker", orientation
    camera = add_photo(addon, capture, "a.jpg", stored, exif=exif, quality=95)
    assert strokes.exif_orientation(capture / "images" / "a.jpg") == orientation
    camera.data["refgs_size"] = [HEIGHT, WIDTH] if orientation in (6, 8) else [WIDTH, HEIGHT]
    canvas = strokes.add_canvas(capture, camera)
    with Image.open(capture / "images" / "a.jpg") as photo:
        turns = {1: 0, 3: 2, 6: 3, 8: 1}[orientation]
        upright = np.rot90(np.asarray(photo.convert("L")), turns) / 255
    np.testing.assert_allclose(pixels_of(canvas)[..., 0], 0.2 + 0.6 * upright, atol=0.06)


def test_a_large_photo_is_reduced(addon, capture):
    camera = add_photo(addon, capture, "a.png", np.zeros((900, 3200, 3), np.uint8))
    camera.data["refgs_size"] = [3200, 900]
    assert list(strokes.add_canvas(capture, camera).size) == [1600, 450]


def test_photos_that_differ_in_their_suffix(addon, capture):
    first, second = (add_photo(addon, capture, name) for name in ("a.jpg", "a.png"))
    files = [strokes.add_canvas(capture, camera)["refgs_strokes"] for camera in (first, second)]
    assert files == [str(capture / "strokes" / name) for name in ("a.jpg.png", "a.png.png")]


def test_photos_that_cannot_be_painted_on(addon, capture, tmp_path):
    assert not bpy.ops.refgs.paint_strokes.poll()
    camera = addon.camera = add_photo(addon, capture, "a.png")
    (capture / "images" / "a.png").write_text("no picture")
    with pytest.raises(RuntimeError, match="Blender cannot open"):
        bpy.ops.refgs.paint_strokes()
    (capture / "images" / "a.png").unlink()
    with pytest.raises(InputError, match="does not exist"):
        strokes.add_canvas(capture, camera)
    with pytest.raises(InputError, match="is not a photo of"):
        strokes.add_canvas(tmp_path / "another", camera)
    assert not strokes.canvases()


def half(kind: str, path: Path) -> None:
    """Write a mask whose right half is the object."""
    right = np.zeros((HEIGHT, WIDTH), np.uint8)
    right[:, WIDTH // 2 :] = 1
    if kind == "palette":
        picture = Image.fromarray(right, "P")
        picture.putpalette([0, 0, 0, 0, 0, 128])
    elif kind == "alpha":
        picture = Image.fromarray(np.dstack([np.full((HEIGHT, WIDTH, 3), 255, np.uint8), 255 * right]))
    else:
        picture = Image.fromarray(right * {"white": 255, "zero and one": 1}[kind])
    picture.save(path)


@pytest.mark.parametrize("kind", ["white", "zero and one", "palette", "alpha"])
def test_a_canvas_shows_the_mask_that_the_trainer_found(addon, capture, tmp_path, kind):
    Image.fromarray(np.full((HEIGHT, WIDTH, 3), 128, np.uint8)).save(capture / "images" / "a.jpg")
    (capture / "Mask").mkdir()
    half(kind, capture / "Mask" / "mask_a.png")
    lens = {"fl_x": 90.0, "fl_y": 90.0, "cx": 32.0, "cy": 24.0, "w": WIDTH, "h": HEIGHT}
    files = {"file_path": "images/a", "photo": "images/a.jpg", "mask": "Mask/mask_a.png"}
    frame = files | lens | {"transform_matrix": np.eye(4).tolist()}
    (tmp_path / "cameras.json").write_text(json.dumps({"frames": [frame]}))
    (camera,) = show_cameras(addon, capture, tmp_path / "cameras.json").objects
    canvas = strokes.add_canvas(capture, camera)
    red = pixels_of(canvas)[..., 0] - pixels_of(canvas)[..., 1] > 0.2
    assert red[:, : WIDTH // 2].all() and not red[:, WIDTH // 2 :].any()
    # A mask that the trainer made takes its place, on canvases that are made later, too.
    (capture / "masks").mkdir()
    Image.fromarray(np.full((HEIGHT, WIDTH), 255, np.uint8)).save(capture / "masks" / "a.png")
    strokes.show_masks(capture, {"images/a.jpg": "masks/a.png"})
    assert np.ptp(pixels_of(canvas)[..., :3]) < 0.05
    bpy.data.images.remove(canvas)
    assert np.ptp(pixels_of(strokes.add_canvas(capture, camera))[..., :3]) < 0.05


@pytest.mark.parametrize(("paints", "color"), [("object", 1), ("rest", 0), ("nothing", 1)])
def test_brushes(addon, paints, color):
    assert bpy.ops.refgs.choose_brush(paints=paints) == {"FINISHED"}
    settings = bpy.context.tool_settings
    owner = getattr(settings.image_paint, "unified_paint_settings", None) or settings.unified_paint_settings
    assert list(owner.color) == [color] * 3
