"""Test that `refgs check` says what of a capture is not used."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from refgs.capture import find_layout, read_capture
from refgs.capture.check import describe
from refgs.capture.not_used import not_used
from tests.makers import gain_maps
from tests.makers.captures import (
    colmap,
    edit,
    nerf_blender,
    nerfstudio,
    nero,
    shiny_blender,
    stanford_orb,
    tensoir,
    write,
)

HALF = np.tri(48, 64, dtype=np.uint8) * 255


def test_photos_without_a_camera(tmp_path):
    folder = colmap(tmp_path)
    for name in ("images/a.png", "images/cam2/0001.png", "images/cam2/0002.png"):
        write(folder / name, HALF)
    for name in (
        "images/0001_normal.png",
        "images/0002_mask.png",
        "images/._b.png",
        "images/a_mask.png",
        "c.png",
    ):
        write(folder / name, HALF)
    (folder / "images" / "0001.CR2").touch()
    said = "Not used: 3 photos without a camera, first images/a.png"
    assert said in describe(read_capture(folder))
    assert "Not used" not in "\n".join(describe(read_capture(colmap(tmp_path / "whole"))))


def test_a_photo_whose_frame_was_removed(tmp_path):
    folder = nerf_blender(tmp_path)
    edit(folder / "transforms_train.json", lambda data: data["frames"].pop(3))
    assert not_used(read_capture(folder)) == ["1 photo without a camera, first train/r_3.png"]


@pytest.mark.parametrize("make", [nerf_blender, nerfstudio, colmap, nero, tensoir, stanford_orb, shiny_blender])
def test_nothing_is_said_of_a_whole_capture(tmp_path, make):
    assert not_used(read_capture(make(tmp_path / "a" / "b"))) == []


def test_gain_maps_are_said_once(tmp_path):
    folder = nerfstudio(tmp_path)
    names = {2: "Ultra HDR.jpg", 3: "Apple.heic", 5: "with a preview.jpg"}
    for number, name in names.items():
        (folder / "images" / f"{number:04d}.png").unlink()
        (gain_maps.WITH | gain_maps.WITHOUT)[name](folder / "images" / f"{number:04d}{Path(name).suffix}")
    lines = describe(read_capture(folder))
    assert [line for line in lines if "gain map" in line] == [
        "Not used: the HDR gain maps of 2 photos, first images/0002.jpg: they are read as the standard picture"
    ]


def test_masks_of_no_photo(tmp_path):
    folder = nerfstudio(tmp_path)
    for i in range(16):
        write(folder / "masks" / f"{i:04d}.png", HALF)
    for name in ("masks/0016.png", "masks/other/0001.png", "masks/._0001.png"):
        write(folder / name, HALF)
    capture = read_capture(folder)
    assert capture.masked
    assert not_used(capture) == [
        "2 masks of no photo with a camera, first masks/0016.png: give masks their photos' names"
    ]


def test_white_masks_are_said_once(tmp_path):
    folder = nerfstudio(tmp_path)
    for i in range(16):
        write(folder / "masks" / f"{i:04d}.png", np.full((48, 64), 255, np.uint8))
    capture = read_capture(folder)
    assert "white (opaque) everywhere" in capture.warnings[0] and not_used(capture) == []


@pytest.mark.parametrize("name", ["silhouettes", "Segmentation", "object_masks", "mattes"])
def test_folders_that_look_like_masks(tmp_path, name):
    folder = nerfstudio(tmp_path)
    for i in range(3):
        write(folder / name / f"{i:04d}.png", HALF)
    write(folder / "renders" / "0001.png", HALF)
    said = f"3 pictures in {name}, which may be masks, first 0000.png: masks are read from the folder masks"
    assert not_used(read_capture(folder)) == [said]
    edit(
        folder / "transforms.json",
        lambda data: [frame.update(mask_path=f"{name}/{i:04d}.png") for i, frame in enumerate(data["frames"][:3])],
    )
    assert not_used(read_capture(folder)) == []


def test_masks_that_a_layout_does_not_read(tmp_path):
    folder = nero(tmp_path / "bell")
    write(folder / "masks" / "0.png", HALF)
    assert not_used(read_capture(folder)) == [
        "1 picture in masks, which may be masks, first 0.png: masks are read from the folder masks"
    ]


@pytest.mark.parametrize(
    ("ours", "others"),
    [
        ("sparse/1", ["sparse/0", "sparse/2"]),
        ("sparse/10", ["sparse/2"]),
        ("sparse", ["sparse/0"]),
        ("colmap/sparse/0", ["sparse/0"]),
        ("dense/sparse", ["sparse/0"]),
        ("dense/0/sparse", []),
        ("colmap/sparse", []),
        (".", []),
    ],
)
@pytest.mark.parametrize("binary", [True, False])
def test_the_largest_model_is_used(tmp_path, ours, others, binary):
    folder = colmap(tmp_path / "capture", binary)
    small = colmap(tmp_path / "small", binary, count=5)
    model = (folder / "sparse").rename(tmp_path / "model") / "0"
    (folder / ours).mkdir(parents=True, exist_ok=True)
    for file in model.iterdir():
        shutil.copy(file, folder / ours)
    for other in others:
        shutil.copytree(small / "sparse" / "0", folder / other)
    capture = read_capture(folder)
    assert len(capture.views) == 16 and len(capture.points) == 50
    warnings = [f"{len(others) + 1} COLMAP models: {ours} is used, as no other has more than its 16 photos; "]
    assert (
        capture.warnings == [f"{warnings[0]}{len(others)} not used, first {others[0]} (5 photos)"]
        if others
        else not capture.warnings
    )


def test_the_first_of_equal_models_is_used(tmp_path):
    folder = colmap(tmp_path)
    shutil.copytree(folder / "sparse" / "0", folder / "sparse" / "1")
    (folder / "sparse" / "2").mkdir()
    (folder / "sparse" / "2" / "images.bin").write_bytes(b"broken")
    assert len(read_capture(folder).views) == 16
    assert "sparse/0 is used" in read_capture(folder).warnings[0]
    assert "2 not used, first sparse/1 (16 photos)" in read_capture(folder).warnings[0]


def test_a_capture_that_is_named_colmap_is_its_own(tmp_path):
    colmap(tmp_path / "colmap")
    (tmp_path / "cameras.txt").write_text("of something else")
    assert find_layout(tmp_path) is None and find_layout(tmp_path / "colmap") == "colmap"


def test_a_model_uses_the_undistorted_photos_beside_it(tmp_path):
    folder = colmap(tmp_path)
    (folder / "dense").mkdir()
    (folder / "sparse" / "0").rename(folder / "dense" / "sparse")
    assert {view.image_path.parent for view in read_capture(folder).views} == {folder / "images"}
    shutil.copytree(folder / "images", folder / "dense" / "images")
    for i in range(16):
        write(folder / "dense" / "masks" / f"{i:04d}.png", np.tri(48, 64, dtype=np.uint8) * 255)
    views = read_capture(folder).views
    assert {view.image_path.parent for view in views} == {folder / "dense" / "images"}
    assert {view.mask_path.parent for view in views} == {folder / "dense" / "masks"}
