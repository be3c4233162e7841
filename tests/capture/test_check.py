"""Test the lines that `refgs check` prints and the files that it writes."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from refgs.capture import read_capture
from refgs.capture.check import check, describe
from refgs.errors import InputError
from tests.makers.captures import CENTRE, ball, colmap, edit, look_at, nerf_blender, nerfstudio, ring, write


def text(folder) -> str:
    return "\n".join(describe(read_capture(folder)))


def test_an_object_with_masks(tmp_path):
    said = text(nerf_blender(tmp_path, {"train": 24, "test": 4}))
    for part in (
        "NeRF-Blender",
        "28, 24 to train on, 4 to test on",
        "64×48",
        "56.1° wide, no distortion",
        "28 views (the photos' alpha), covering 11 %",
        "12 to 52° above it, 345° around it",
        "Taken for an object: the photos have masks. So what is outside the masks is not reconstructed",
    ):
        assert part in said, said
    assert "Warning" not in said


def test_distortion_points_and_a_guess(tmp_path):
    said = text(colmap(tmp_path, model=(2, "SIMPLE_RADIAL", [60.0, 32.0, 24.0, -0.1])))
    assert "COLMAP" in said and "distortion removed from 16 views" in said and "50 structure-from-motion" in said
    assert "Masks: none" in said and "a guess" in said
    assert "Object: not masked. refgs train and refgs masks look for it in the box region.centre=[" in said
    assert "Warning: no masks" not in said and "Warning: 14 training views are few" in said


def test_warnings_name_the_first_view(tmp_path):
    folder = nerfstudio(tmp_path, count=32)
    for i, pose in enumerate(ring(32)):
        if i != 3:
            mask = ball(pose, 64, 48, 60.0)[..., 3]
            write(folder / "masks" / f"{i:04d}.png", mask if i != 5 else np.zeros_like(mask))
    write(folder / "images" / "0007.png", np.full((48, 64, 3), 255, np.uint8))
    write(folder / "images" / "0009.png", np.full((48, 64), 50, np.uint8))
    edit(folder / "transforms.json", lambda data: data["frames"][20].update(cx=400.0))
    said = text(folder)
    for part in (
        "1 of 32 views have no mask, first 0003.png: make",
        "1 of 32 views have an empty mask, first 0005.png: make",
        "greyscale, first 0007.png: put",
        "clipped to white over a tenth of the subject, first 0007.png: photograph",
        "exposure varies: 0007.png",
        "1 of 32 views do not see the centre, first 0020.png: where",
    ):
        assert part in said, said


@pytest.mark.parametrize("make", [nerfstudio, nerf_blender])
def test_axes_of_opencv_are_told_once(tmp_path, make):
    """Check that one line says that a file's axes look like OpenCV's, and that its advice gives the same cameras as OpenGL's axes."""
    folder, names = make(tmp_path), ("transforms.json", "transforms_train.json", "transforms_test.json")
    expected = [view.camera.world_to_camera for view in read_capture(folder).views]
    assert "OpenCV" not in text(folder)

    def turn(data):
        for frame in data["frames"]:
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])).tolist()

    files = [folder / name for name in names if (folder / name).exists()]
    for file in files:
        edit(file, turn)
    said = [line for line in text(folder).splitlines() if "OpenCV" in line or "see the centre" in line]
    assert len(said) == 1 and said[0].startswith("Warning: 16 of 16 cameras look away")
    assert 'add "camera_convention": "opencv" to the file' in said[0]
    for file in files:
        edit(file, lambda data: data.update(camera_convention="opencv"))
    found = [view.camera.world_to_camera for view in read_capture(folder).views]
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert "OpenCV" not in text(folder)
    edit(files[0], lambda data: data.update(camera_convention="left-handed"))
    with pytest.raises(InputError, match="camera_convention is left-handed, which is not known"):
        read_capture(folder)


def test_cameras_in_a_room_are_not_taken_for_opencvs(tmp_path):
    rng = np.random.default_rng(0)
    poses = [pose @ np.diag([-1, 1, -1, 1]) for pose in ring(16, 1.0)]  # turned around
    for pose in poses:
        pose[:3, 3] += rng.uniform(-0.7, 0.7, 3)
    said = text(nerfstudio(tmp_path, poses=poses))
    assert "the cameras look outwards" in said and "OpenCV" not in said and "see the centre" not in said


def arc(degrees: float, astray: float = 0.0) -> list[np.ndarray]:
    """Return cameras on a part of a ring about an object. They look past it by about `astray` times their distance."""
    rng, poses = np.random.default_rng(0), []
    for k in range(24):
        azimuth, elevation = np.radians(degrees) * (k / 23 - 0.5), (0.3, 0.8)[k % 2]
        away = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
        poses.append(look_at(4 * np.array(away), 4 * astray * rng.normal(size=3)))
    return poses


def room(kind: str) -> list[np.ndarray]:
    """Return cameras in a room: from its middle outwards, on a walk through it, along a wall, or across it from one half or all around."""
    rng, poses = np.random.default_rng(0), []
    for k in range(40):
        part = k / 39
        across = rng.uniform((-2, -2, 0), (2, 2, 2))
        turn = 2 * np.pi * part * (3 if kind == "walk" else 1)
        ahead = np.array([np.cos(turn), np.sin(turn), 0.0])
        at = {
            "outwards": 0.5 * ahead + rng.normal(size=3) * 0.2,
            "walk": np.array([4 * part, 0.3 * np.sin(9 * part), 1.5]),
            "along": np.array([0.0, 6 * part, 1.5]) + 0.05 * rng.normal(size=3),
            "from one half": np.array([rng.uniform(0, 1.5), rng.uniform(0, 6), 1.6]),
            "from all around": 3 * ahead + (0, 0, 1.6),
        }[kind]
        to = {
            "along": at + np.array([1, 0.1 * rng.normal(), 0.1 * rng.normal()]),
            "from one half": np.array([6, rng.uniform(0, 6), rng.uniform(0.3, 2.3)]),
            "from all around": across,
        }.get(kind, at + ahead)
        poses.append(look_at(at, to))
    return poses


AROUND, ASIDE = "surround one place they look at", "look at one place, from one side of it"


@pytest.mark.parametrize(
    ("poses", "why"),
    [
        (arc(345), AROUND),
        (arc(270), AROUND),
        (arc(180), ASIDE),
        (arc(180, 0.06), ASIDE),
        (arc(120), ASIDE),
        (arc(120, 0.08), ASIDE),
        (arc(60), ASIDE),
    ],
)
def test_cameras_that_look_at_one_place_show_an_object(tmp_path, poses, why):
    said = text(nerfstudio(tmp_path, poses=poses)).splitlines()
    (line,) = [line for line in said if line.startswith("Taken for")]
    assert line == (
        f"Taken for an object: the cameras {why} (no masks: a guess). So refgs train makes masks of it first, and leaves out its "
        "surroundings; it keeps them with --set image.masks=off"
    )
    assert any(line.startswith("Object: not masked") for line in said)


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("outwards", "the cameras look outwards"),
        ("walk", "the cameras look outwards"),
        ("along", ""),  # axes are parallel: either may be said
        ("from one half", "there are no masks and the cameras do not look at one place"),
        ("from all around", "there are no masks and the cameras do not look at one place"),
    ],
)
def test_cameras_in_a_room_show_no_object(tmp_path, kind, why):
    said = text(nerfstudio(tmp_path, poses=room(kind))).splitlines()
    (line,) = [line for line in said if line.startswith("Taken for")]
    assert line.startswith(f"Taken for a room or open scene: {why}")
    outwards = "cameras look outwards" in line
    assert ("So no masks are made, and all that the photos show is reconstructed" in line) == outwards
    assert ("So refgs train looks for an object all the same, to mask it" in line) != outwards
    assert any(line.startswith("Object: not masked") for line in said) != outwards


def test_what_follows_where_no_masks_are_made_or_some_are_missing(tmp_path):
    outwards = [look_at((0, 0, 0), (np.cos(a), np.sin(a), 0.1)) for a in np.arange(24) * 2 * np.pi / 24]
    for i, pose in enumerate(outwards):
        pose[:3, 3] = 0.1 * np.array([np.cos(i), np.sin(i), 0])
    said = text(nerfstudio(tmp_path / "room", poses=outwards))
    assert "the cameras look outwards. So no masks are made, and all that the photos show is" in said
    some = nerfstudio(tmp_path / "some", count=24)
    for i, pose in enumerate(ring(24)[:20]):
        write(some / "masks" / f"{i:04d}.png", ball(pose, 64, 48, 60.0)[..., 3])
    assert "have masks. So what is around it in photos without a mask is reconstructed, too" in text(some)


def test_masks_that_look_inverted(tmp_path):
    folder = nerfstudio(tmp_path, count=24)
    for i, pose in enumerate(ring(24)):
        mask = ball(pose, 64, 48, 60.0)[..., 3]
        write(folder / "masks" / f"{i:04d}.png", 255 - mask if i in (5, 9) else mask)
    said = text(folder)
    assert (
        "Warning: 2 of 24 masks look inverted, white in the corners and black in the middle, first masks/0005.png: inv"
        in said
    )
    for i in (5, 9):
        write(folder / "masks" / f"{i:04d}.png", np.full((48, 64), 255, np.uint8))  # the object fills the photo
    assert "inverted" not in text(folder)


def test_blurred_photos_are_named(tmp_path):
    folder = nerfstudio(tmp_path, count=24)
    rng = np.random.default_rng(0)
    for i in range(24):
        grains = cv2.GaussianBlur(rng.uniform(20, 120 + 5 * i, (48, 64, 3)), None, 0.7)  # of any contrast
        write(folder / "images" / f"{i:04d}.png", grains.astype(np.uint8))
    assert "blurred" not in text(folder)
    for i in (4, 20):
        file = folder / "images" / f"{i:04d}.png"
        write(file, cv2.GaussianBlur(cv2.imread(str(file))[..., ::-1], None, 2.0))
    assert "Warning: 2 of 24 views look blurred beside the others, first 0004.png: look" in text(folder)


def test_what_is_shown_of_it(tmp_path):
    """Check the files that `check` writes: cameras.json with all cameras, and thumbnails of up to 12 photos.

    If the capture has masks, the thumbnails have an alpha channel.
    """
    capture = read_capture(nerf_blender(tmp_path / "capture", {"train": 24, "test": 6}))
    out = tmp_path / "new" / "out"
    found = check(capture, out)
    assert found["capture"] == str(tmp_path / "capture")
    assert any("30, 24 to train on" in line for line in found["lines"])
    photos = [frame["photo"] for frame in json.loads(Path(found["cameras"]).read_text())["frames"]]
    assert photos[22:26] == ["train/r_22.png", "train/r_23.png", "test/r_0.png", "test/r_1.png"]
    assert np.linalg.norm(np.subtract(found["centre"], CENTRE)) < 0.1 and 0.4 < found["radius"] < 0.7
    assert len(set(found["thumbnails"])) == 12
    picture = cv2.imread(found["thumbnails"][0], cv2.IMREAD_UNCHANGED)
    assert picture.shape == (48, 64, 4) and 0 < (picture[..., 3] > 0).mean() < 0.5
    assert [path.name for path in out.iterdir() if path.suffix != ".png"] == ["cameras.json"]
    large = nerfstudio(tmp_path / "large", count=5)
    for photo in (large / "images").iterdir():
        write(photo, cv2.resize(cv2.imread(str(photo)), (640, 480)))
    found = check(read_capture(large), tmp_path / "out")
    assert [cv2.imread(file, -1).shape for file in found["thumbnails"]] == [(96, 128, 3)] * 5


def test_every_image_is_decoded(tmp_path):
    folder = nerfstudio(tmp_path)
    for name in ("0002.png", "0006.png"):
        path = folder / "images" / name
        path.write_bytes(path.read_bytes()[:120])
    with pytest.raises(InputError, match=r"2 of 16 views cannot be read, the first: .*0002\.png"):
        text(folder)
