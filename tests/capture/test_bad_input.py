"""Test that broken captures are refused with one line that names the file or frame at fault."""

import json
import os
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from refgs.capture import load_normals, load_view, published_normals, read_cameras, read_capture
from refgs.capture.stanford_orb import novel_views
from refgs.errors import InputError, one_line
from tests.makers.captures import (
    colmap,
    edit,
    nerf_blender,
    nerfstudio,
    nero,
    ring,
    shiny_blender,
    stanford_orb,
    tensoir,
    write,
)

SMALL_MASK = np.full((24, 32), 255, np.uint8)


def refused(read, *parts: str) -> None:
    """Assert that `read` raises an InputError of one line that holds all `parts`."""
    with pytest.raises(InputError) as error:
        read()
    message = str(error.value)
    assert "\n" not in message
    for part in parts:
        assert part in message, message


def test_no_such_folder(tmp_path):
    refused(lambda: read_capture(tmp_path / "nowhere"), "nowhere", "no such folder")
    (tmp_path / "film.mp4").touch()
    refused(lambda: read_capture(tmp_path / "film.mp4"), "film.mp4: this is a file", "refgs frames")


def test_folder_without_a_capture(tmp_path):
    refused(lambda: read_capture(tmp_path), "transforms_train.json", "transforms.json", "sparse/0")
    write(tmp_path / "images" / "a.png", np.zeros((8, 8), np.uint8))
    refused(lambda: read_capture(tmp_path), "no cameras", "refgs poses")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('{"frames": [\n{"file_path": "a",,}]}', "line 2"),
        ("", "line 1"),
        ("[1, 2]", "should be a table"),
        ('{"frames": 3}', "frames"),
        ('{"frames": [{"transform_matrix": []}]}', "file_path"),
        ('{"frames": ["a"]}', "frames.0 should be a table"),
        ('{"frames": []}', "0 training views"),
        ('{"frames": ' + "[" * 50_000, "nested too deeply"),
        ('{"frames": [], "w": ' + "9" * 5000 + "}", "not JSON"),
    ],
)
def test_transforms_that_are_not(tmp_path, text, says):
    (tmp_path / "transforms.json").write_text(text)
    refused(lambda: read_capture(tmp_path), says)


@pytest.mark.parametrize(
    ("make", "name", "spoil", "says"),
    [
        (
            nerfstudio,
            "transforms.json",
            lambda file: file.write_bytes(b"\xff\xd8\xff\x00"),
            ["transforms.json", "text"],
        ),
        (nerfstudio, "images/0002.png", lambda file: file.write_text("not a picture"), ["0002.png", "not an image"]),
        (nerfstudio, "masks/0004.png", lambda file: write(file, SMALL_MASK), ["0004.png", "32×24", "64×48"]),
        (colmap, "sparse/0/cameras.bin", Path.unlink, ["cameras.bin", "missing"]),
    ],
)
def test_a_file_that_is_spoiled_or_missing(tmp_path, make, name, spoil, says):
    folder = make(tmp_path / "capture")
    spoil(folder / name)
    refused(lambda: read_capture(folder), *says)


@pytest.mark.parametrize("make", [nerf_blender, nerfstudio, colmap, nero, tensoir, stanford_orb])
def test_most_images_missing(tmp_path, make):
    folder = make(tmp_path / "a" / "b")
    photos = sorted(view.image_path for view in read_capture(folder).train_views)
    for path in photos[:-2]:
        path.unlink()
    refused(lambda: read_capture(folder), " of the 1", "images it names are missing, the first is")


def test_two_views(tmp_path):
    refused(lambda: read_capture(nerf_blender(tmp_path, {"train": 2, "test": 4})), "2 training views", "three")


def test_three_views_of_which_one_is_held_out(tmp_path):
    refused(lambda: read_capture(nerfstudio(tmp_path, count=3)), "2 training views (of 3")


def test_cameras_in_one_place(tmp_path):
    poses = ring(12)
    for pose in poses:
        pose[:3, 3] = (4, 5, 6)
    refused(lambda: read_capture(nerfstudio(tmp_path, poses=poses)), "one place")


def _pose_entry(row, column, value):
    """Return a function that sets one entry of a pose matrix to `value`."""
    return lambda matrix: matrix[row].__setitem__(column, value)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_pose_entry(1, 3, float("nan")), "NaN"),
        (_pose_entry(0, 0, float("inf")), "NaN or infinity"),
        (_pose_entry(1, 3, 1e308), "1e+308 from the origin"),
        (_pose_entry(1, 3, 2.9e150), "2.9e+150 from the origin"),
        (lambda m: [row.__setitem__(slice(0, 3), [5e-324 * x for x in row[:3]]) for row in m[:3]], "inverted"),
        (_pose_entry(0, 0, "abc"), "transform_matrix.0.0 should be a valid number"),
        (lambda m: m.pop(), None),  # 3×4 is read
        (lambda m: m.pop(0) and m.pop(0), "4×4"),
        (lambda m: [row.__setitem__(0, 0.0) for row in m], "inverted"),
        (lambda m: [row.__setitem__(slice(0, 3), [0, 0, 0]) for row in m], "inverted"),
        (_pose_entry(3, 0, 0.5), "inverted"),
        (lambda m: [row.__setitem__(0, -row[0]) for row in m[:3]], "left-handed"),
        (lambda m: [row.__setitem__(0, 1.3 * row[0]) for row in m[:3]], "30%"),
        (lambda m: [row.__setitem__(0, 1.004 * row[0]) for row in m[:3]], None),
    ],
)
def test_poses(tmp_path, change, says):
    folder = nerf_blender(tmp_path)
    edit(folder / "transforms_train.json", lambda data: change(data["frames"][5]["transform_matrix"]))
    if says is None:
        rotation = read_capture(folder).views[5].camera.world_to_camera[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    else:
        refused(lambda: read_capture(folder), says, "train/r_5")


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"fl_x": 0}, "focal length"),
        ({"fl_x": float("nan")}, "focal length"),
        ({"fl_x": "wide"}, "fl_x should be a valid number"),
        ({"fl_x": None, "fl_y": None}, "no focal length"),
        ({"fl_x": 10**400}, "frame images/0008.png: fl_x should be a valid number"),
        ({"w": 0.3, "h": 0.2}, "size is zero"),
        ({"transform_matrix": None}, "frame images/0008.png: transform_matrix should be a valid list"),
        ({"fl_x": None, "fl_y": None, "camera_angle_x": 0}, "focal length"),
        ({"k1": float("inf")}, "distortion"),
        ({"k1": -30.0}, "distortion is too strong"),
        ({"fl_x": 1e308}, "focal length of 1e+308"),
        ({"fl_y": 5e-324}, "focal length of 4.94066e-324"),
        ({"cx": -1e308}, "principal point (-1e+308 24) is far outside"),
        ({"h": 64}, "64×64 pixels but the photo has 64×48"),
        ({"mask_path": "masks/gone.png"}, "masks/gone.png is missing"),
        ({"file_path": "images/0000.png"}, "0000.png: the capture names this photo 2 times"),
    ],
)
def test_frame_values(tmp_path, values, says):
    folder = nerfstudio(tmp_path)
    edit(folder / "transforms.json", lambda data: data["frames"][8].update(values))
    refused(lambda: read_capture(folder), says)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("kept", [0.1, 0.55, 0.93])
def test_colmap_files_cut_short(tmp_path, name, binary, kept):
    file = colmap(tmp_path, binary) / "sparse" / "0" / f"{name}.{'bin' if binary else 'txt'}"
    data = file.read_bytes()
    header = 0 if binary else data.index(b"\n", data.rfind(b"# ")) + 1
    file.write_bytes(data[: max(int(kept * len(data)), header)])
    refused(lambda: read_capture(tmp_path), file.name, "truncated")


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("binary", [True, False])
def test_colmap_files_with_gigabytes_of_zeros(tmp_path, name, binary):
    """Check files that take no room on the disk: 30 GB of zeros, in a file that says that it has 2⁶⁰ entries."""
    file = colmap(tmp_path, binary) / "sparse" / "0" / f"{name}.{'bin' if binary else 'txt'}"
    file.write_bytes((1 << 60).to_bytes(8, "little") if binary else b"# a comment\n")
    os.truncate(file, 30 << 30)
    refused(lambda: read_capture(tmp_path), file.name, "truncated or not COLMAP's")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "model", [(3, "RADIAL", [60.0, 32, 24, 0, 1e308]), (5, "OPENCV_FISHEYE", [60.0, 60, 32, 24, 0, 0, 0, 1e308])]
)
def test_colmap_coefficients_of_1e308(tmp_path, model):
    refused(
        lambda: read_capture(colmap(tmp_path, True, model)),
        "0000.png",
        "distortion is too strong",
        model[1].replace("RADIAL", "BROWN"),
    )


def test_colmap_focal_length_nan(tmp_path):
    model = (1, "PINHOLE", [float("nan"), 60.0, 32.0, 24.0])
    refused(lambda: read_capture(colmap(tmp_path, True, model)), "0000.png", "focal length")


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("1 nan 0 0 0 1 2 3 7 0000.png", ("0000.png", "NaN")),
        ("1 1e308 0 0 1e308 1e308 2 3 7 0000.png", ("0000.png", "e+308 from the origin")),
        ("1 1 0 0 0 7 0000.png", ("images.txt", "truncated or not COLMAP's")),
    ],
    ids=["NaN", "1e308", "numbers missing"],
)
def test_colmap_pose(tmp_path, line, says):
    file = colmap(tmp_path, binary=False) / "sparse" / "0" / "images.txt"
    lines = file.read_text().splitlines()
    lines[2] = line
    file.write_text("\n".join(lines))
    refused(lambda: read_capture(tmp_path), *says)


def test_points_without_coordinates(tmp_path):
    folder = nerfstudio(tmp_path)
    (folder / "points.ply").write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n")
    edit(folder / "transforms.json", lambda data: data.update(ply_file_path="points.ply"))
    refused(lambda: read_capture(folder), "points.ply", "no points with x, y and z", "ply_file_path")


@pytest.mark.parametrize("name", ["/proc/kcore", "/proc/self/pagemap", "../points.ply", "a/../../points.ply"])
def test_points_outside_of_the_capture_are_not_read(tmp_path, name):
    folder = nerfstudio(tmp_path / "capture", 4)
    (tmp_path / "points.ply").write_bytes(b"ply")
    edit(folder / "transforms.json", lambda data: data.update(ply_file_path=name))
    refused(
        lambda: read_capture(folder), "points.ply" if "points" in name else name, "ply_file_path names a file outside"
    )


@pytest.mark.skipif(os.name != "posix", reason="needs pipes")
@pytest.mark.parametrize("which", ["mask", "photo", "points", "normals"])
def test_pipes_in_a_capture_are_refused_or_not_found(tmp_path, which):
    """Check that nobody waits for a pipe to be written. The test's time limit ends it otherwise."""
    folder = nerfstudio(tmp_path / "capture", 5)
    photo = sorted((folder / "images").iterdir())[0]
    place = {
        "mask": folder / "masks" / f"{photo.stem}.png",
        "photo": photo,
        "points": folder / "points.ply",
        "normals": folder / "normals" / f"{photo.stem}.npy",
    }[which]
    place.parent.mkdir(exist_ok=True)
    place.unlink(missing_ok=True)
    os.mkfifo(place)
    if which == "points":
        edit(folder / "transforms.json", lambda data: data.update(ply_file_path="points.ply"))

    def read():
        capture = read_capture(folder)
        for view in capture.views:
            load_normals(replace(view, prior_normals=place if which == "normals" else None))

    if which in ("mask", "photo"):  # as if it were not there
        capture = read_capture(folder)
        assert [view.mask_path for view in capture.views] == [None] * (4 if which == "photo" else 5)
    else:
        refused(read, place.name, "not a file" if which == "points" else "not an array of NumPy")


def test_some_photos_named_absolutely(tmp_path, monkeypatch):
    folder = nerfstudio(tmp_path)
    photo = str(folder / "images" / "0003.png")
    edit(folder / "transforms.json", lambda data: data["frames"][3].update(file_path=photo))
    monkeypatch.chdir(tmp_path.parent)
    assert len(read_capture(Path(tmp_path.name)).views) == 16


def test_photos_that_differ_in_their_endings_only(tmp_path):
    folder = nerfstudio(tmp_path)
    (folder / "images" / "0002.png").rename(folder / "images" / "0003.webp")
    edit(folder / "transforms.json", lambda data: data["frames"][2].update(file_path="images/0003.webp"))
    refused(lambda: read_capture(folder), "2 photos are named 0003")


def test_masks_all_empty(tmp_path):
    folder = nerfstudio(tmp_path)
    for i in range(16):
        write(folder / "masks" / f"{i:04d}.png", np.zeros((48, 64), np.uint8))
    refused(lambda: read_capture(folder), "/masks: all 16 masks are empty", "0000.png", "Remove them")


def test_masks_all_white(tmp_path):
    folder = nerfstudio(tmp_path)
    for i in range(16):
        write(folder / "masks" / f"{i:04d}.png", np.full((48, 64), 255, np.uint8))
    capture = read_capture(folder)
    assert not any(view.masked for view in capture.views)
    assert [warning for warning in capture.warnings if "white (opaque) everywhere" in warning]


def test_raw_of_an_unknown_camera(tmp_path):
    folder = nerfstudio(tmp_path)
    (folder / "images" / "0003.png").unlink()
    (folder / "images" / "0003.cr3").write_bytes(b"something else" * 100)
    edit(folder / "transforms.json", lambda data: data["frames"][3].update(file_path="images/0003.cr3"))
    refused(lambda: read_capture(folder), "0003.cr3", "LibRaw does not know", "DNG")


def test_a_program_for_a_printer_is_no_photo(tmp_path):
    """Check that an EPS with a photo's name is refused: to read one, Pillow starts Ghostscript."""
    folder = nerfstudio(tmp_path)
    Image.new("RGB", (64, 48)).save(folder / "images" / "0003.png", "EPS")
    refused(lambda: read_capture(folder), "0003.png", "not an image")


def test_image_truncated_since(tmp_path):
    view = read_capture(nerfstudio(tmp_path)).views[5]
    data = view.image_path.read_bytes()
    view.image_path.write_bytes(data[: len(data) // 2])
    refused(lambda: load_view(view, 32), view.image_path.name, "truncated")


def test_camera_file(tmp_path):
    refused(lambda: read_cameras(tmp_path / "gone.json"), "gone.json", "no such file")
    file = tmp_path / "path.json"
    frame = {"file_path": "a", "transform_matrix": np.eye(4).tolist()}
    file.write_text(json.dumps({"camera_angle_x": 1.0, "frames": [frame]}))
    refused(lambda: read_cameras(file), "image size", "w and h")
    file.write_text(json.dumps({"frames": []}))
    refused(lambda: read_cameras(file), "no frames")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ((np.eye(4), np.eye(3)), "(3, 4) pose"),
        ((np.eye(3, 4),), "not a pickle"),
        (({"a": 1}, np.eye(3)), "a dict"),
        ((np.array([[None] * 4] * 3), np.eye(3)), "not a pickle"),
        ((np.array([["1"] * 4] * 3), np.eye(3)), "an array of"),
        ((np.full((3, 4), np.nan), np.diag([60.0, 60, 1])), "NaN"),
        ((np.zeros((3, 4)), np.diag([60.0, 60, 1])), "inverted"),
        ((np.eye(3, 4), np.diag([0.0, 60, 1])), "focal length"),
        ((np.eye(3, 4), np.full((3, 3), np.nan)), "focal length"),
        ((np.eye(3, 4), np.array([[60.0, 7, 32], [0, 60, 24], [0, 0, 1]])), "skewed"),
        ((np.diag([1.0, 1, -1, 1])[:3], np.diag([60.0, 60, 1])), "left-handed"),
        ((np.zeros(1 << 20), np.eye(3)), "larger than"),
    ],
)
def test_cameras_of_nero(tmp_path, content, says):
    folder = nero(tmp_path / "bell")
    (folder / "5-camera.pkl").write_bytes(pickle.dumps(content))
    refused(lambda: read_capture(folder), "5-camera.pkl", says)


@pytest.mark.parametrize(
    ("split", "says"),
    [
        ((["1"], ["2", "3"]), "1 + 2 views"),
        ((["1"], [str(i) for i in range(16)]), "which are not the 16"),
        ((["one"], ["two"]), "not the numbers"),
        ((["1"], 2), "not a pickle"),
    ],
)
def test_splits_of_nero(tmp_path, split, says):
    refused(lambda: read_capture(nero(tmp_path / "bell", split=split)), "synthetic_split_128.pkl", says)


def test_missing_photos_among_the_reduced(tmp_path):
    folder = colmap(tmp_path)
    (folder / "images_8").mkdir()
    refused(lambda: read_capture(folder / "images_8"), "16 of the 16", "images_8/0000.png")


def test_published_normals_of_another_size(tmp_path):
    folder = shiny_blender(tmp_path)
    write(folder / "test" / "r_0_normal.png", np.zeros((24, 32, 3), np.uint8))
    capture = read_capture(folder)
    refused(lambda: published_normals(capture.test_views[0]), "r_0_normal.png", "32×24", "64×48")


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda data: data.pop("cam_transform_mat"), "cam_transform_mat is missing"),
        (lambda data: data.update(cam_transform_mat="1,2,3"), "cam_transform_mat is not 16 numbers"),
        (
            lambda data: data.update(cam_transform_mat=",".join("x" * 16)),
            "cam_transform_mat should be a valid number",
        ),
        (lambda data: data.update(cam_angle_x="wide"), "cam_angle_x should be a valid number"),
        (lambda data: data.update(imw=100), "the photo has 64×64"),
    ],
)
def test_cameras_of_tensoir(tmp_path, spoil, says):
    folder = tensoir(tmp_path / "synthetic" / "ball")
    edit(folder / "train_005" / "metadata.json", spoil)
    refused(lambda: read_capture(folder), "train_005", says)


@pytest.mark.parametrize("name", ["/", "..", "a" * 300, "a\nb\0", "\\\\?\\", "C:", "//a/b"])
def test_names_that_are_none_are_left_out(tmp_path, name):
    folder = nerfstudio(tmp_path)
    edit(folder / "transforms.json", lambda data: data["frames"][8].update(file_path=name))
    capture = read_capture(folder)
    assert len(capture.views) == 15
    said = one_line(name.replace("\\", "/"))
    assert capture.warnings == [f"1 of the 16 images in transforms.json are missing and left out, first {said}"]


def test_missing_masks_and_scenes_of_stanford_orb(tmp_path):
    folder = stanford_orb(tmp_path)
    edit(folder / "transforms_novel.json", lambda data: data["frames"][1].pop("scene_name"))
    refused(lambda: novel_views(folder), "transforms_novel.json", "test/0001", "scene_name is missing")
    (folder / "train_mask" / "0003.png").unlink()
    refused(lambda: read_capture(folder), "train/0003", "train_mask/0003.png is missing")
