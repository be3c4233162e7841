"""Test that masks are found by the names that other programs give them."""

import numpy as np
import pytest

from refgs.capture import load_view, read_capture
from refgs.capture.files import Files
from refgs.capture.mask_files import find_masks
from tests.makers.captures import ball, colmap, nerfstudio, ring, write


def matched(folder, *names: str) -> dict[str, str]:
    """Make empty files, and return the masks that are found for those that are .jpg or .heic."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    photos = [folder / name for name in names if name.endswith((".jpg", ".heic"))]
    found = find_masks(Files(folder), photos)
    return {a.relative_to(folder).as_posix(): b.relative_to(folder).as_posix() for a, b in found.items()}


@pytest.mark.parametrize(
    "mask",
    [
        "masks/0001.png",
        "masks/0001.jpg.png",
        "masks/0001.jpg.mask.png",
        "masks/0001.mask.png",
        "masks/0001_mask.png",
        "masks/0001-Mask.PNG",
        "masks/mask_0001.png",
        "masks/0001_alpha.tif",
        "masks/alpha.0001.webp",
        "masks/0001_matte.png",
        "masks/0001.png.png",  # the photo was converted before
        "Masks/images/0001.png",
        "mask/0001.png",
        "alpha/0001.png",
        "images_mask/0001_mask.png",
        "images_masks/0001.png",
        "images/0001_alpha.png",
        "images/0001.jpg.mask.png",
        "images/mask_0001.png",
        "images/masks/0001.png",
        "images/Mask/0001.jpg.mask.png",
        "images/0001_mask.webp",
    ],
)
def test_names_of_masks(tmp_path, mask):
    assert matched(tmp_path, "images/0001.jpg", "images/0002.jpg", mask) == {"images/0001.jpg": mask}


@pytest.mark.parametrize(
    "mask",
    [
        "masks/0001_depth.png",
        "masks/._0001.png",
        "masks/.old/0001.png",
        "images/0001_normal.png",
        "silhouettes/0001.png",
        "masks/00010.png",
    ],
)
def test_names_of_no_masks(tmp_path, mask):
    assert matched(tmp_path, "images/0001.jpg", "images/0002.jpg", mask) == {}


def test_the_most_exact_name_counts(tmp_path):
    found = matched(
        tmp_path, "images/a.jpg", "images/a.heic", "masks/a.jpg.png", "masks/a.heic.mask.png", "masks/a_mask.png"
    )
    assert found == {"images/a.jpg": "masks/a.jpg.png", "images/a.heic": "masks/a.heic.mask.png"}
    found = matched(
        tmp_path / "b", "images/a.jpg", "images/b.jpg", "masks/a.png", "masks/a_mask.png", "mask/b.png", "mask/a.png"
    )
    assert found == {"images/a.jpg": "masks/a.png", "images/b.jpg": "mask/b.png"}


def test_masks_of_photos_in_subfolders(tmp_path):
    photos = [f"images/cam{camera}/000{i}.jpg" for camera in (1, 2) for i in (1, 2)]
    masks = [photo.replace("images", "masks").replace(".jpg", "_mask.png") for photo in photos]
    assert matched(tmp_path / "a", *photos, *masks[1:]) == dict(zip(photos[1:], masks[1:], strict=True))
    assert matched(tmp_path / "b", *photos, "masks/0001.png", "masks/0002.png") == {}  # of which camera?
    apart = [f"cam{camera}/images/000{i}.jpg" for camera in (1, 2) for i in (1, 2)]
    beside = [photo.replace("images", "masks").replace(".jpg", ".png") for photo in apart]
    assert matched(tmp_path / "e", *apart, *beside) == dict(zip(apart, beside, strict=True))
    inner = [photo.replace("/000", "/masks/000").replace(".jpg", ".png") for photo in photos]
    assert matched(tmp_path / "d", *photos, *inner) == dict(zip(photos, inner, strict=True))
    photos[2:] = ["images/cam2/0003.jpg", "images/cam2/0004.jpg"]
    flat = ["masks/0001.png", "masks/0002_mask.png", "masks/0003.jpg.mask.png"]
    assert matched(tmp_path / "c", *photos, *flat) == dict(zip(photos[:3], flat, strict=True))


def test_a_name_in_nfd(tmp_path):
    assert matched(tmp_path, "images/\u00fc.jpg", "masks/u\u0308.png") == {"images/\u00fc.jpg": "masks/u\u0308.png"}


def test_masks_of_reduced_photos(tmp_path):
    folder = colmap(tmp_path)
    for i, pose in enumerate(ring(16)):
        write(folder / "images_2" / f"{i:04d}.png", ball(pose, 32, 24, 30.0)[..., :3])
        write(folder / "masks" / f"{i:04d}.png", ball(pose, 64, 48, 60.0)[..., 3])
        write(folder / "masks_2" / f"{i:04d}.png", ball(pose, 32, 24, 30.0)[..., 3])
    assert read_capture(folder).views[1].mask_path == folder / "masks" / "0001.png"
    assert read_capture(folder / "images_2").views[1].mask_path == folder / "masks_2" / "0001.png"


@pytest.mark.parametrize("name", ["masks/{}.png.mask.png", "mask/{}.png", "images/{}_mask.png"])
def test_the_object_is_what_the_mask_shows(tmp_path, name):
    folder = nerfstudio(tmp_path)
    for i, pose in enumerate(ring(16)):
        write(folder / name.format(f"{i:04d}"), ball(pose, 64, 48, 60.0)[..., 3])
    capture = read_capture(folder)
    assert len(capture.views) == 16 and capture.masked
    for i in (0, 7):
        view = next(view for view in capture.views if view.camera.name == f"{i:04d}")
        assert np.array_equal(load_view(view).alpha, ball(ring(16)[i], 64, 48, 60.0)[..., 3])
