"""Test the second try to find cameras, by learned features: with made matches, and with the networks where they are installed."""

import tomllib
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from refgs.capture import learned, read_capture
from refgs.capture.colmap_steps import epipolar_distance
from refgs.capture.images import read_header, read_image
from refgs.capture.motion import find_cameras
from refgs.capture.poses import OPENGL_TO_OPENCV
from refgs.errors import InputError
from tests.makers.captures import look_at, write, write_as_phone
from tests.makers.speckled import FOCAL, HEIGHT, WIDTH, pose_errors, speckled

POSES = [
    look_at((3.2 * np.cos(angle), 3.2 * np.sin(angle), 1.8 + 0.2 * np.sin(3 * angle)), (0, 0, 0.4))
    for angle in np.linspace(0, 1.4, 8)
]


def nothing(*_) -> None:
    pass


def noise(folder: Path, count: int) -> None:
    """Write photos in which SIFT matches nothing."""
    rng = np.random.default_rng(0)
    for number in range(count):
        write(folder / "images" / f"{number}.png", rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8))


def project(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return the pixels (N, 2) of world points (N, 3) in a photo by `speckled`. `pose` is its camera-to-world matrix."""
    x, y, depth = (np.linalg.inv(pose @ OPENGL_TO_OPENCV) @ np.column_stack([points, np.ones(len(points))]).T)[:3]
    return np.column_stack([FOCAL * x / depth + WIDTH / 2, FOCAL * y / depth + HEIGHT / 2])


def test_what_is_installed_is_what_pyproject_pins():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))
    assert tuple(project["project"]["optional-dependencies"]["learned"]) == learned.NEEDED


def test_photos_that_sift_does_not_match(tmp_path, monkeypatch):
    """Check that learned matches find the cameras of photos in which SIFT finds none. Here they are projected points."""
    noise(tmp_path, len(POSES))
    points = np.random.default_rng(1).uniform([-0.6, -0.6, -0.2], [0.6, 0.6, 1], (300, 3))

    def match(photos, masks, file, progress) -> None:
        places = {f"{n}": project(points, pose).astype(np.float32) for n, pose in enumerate(POSES)}
        same = np.column_stack([np.arange(300, dtype=np.uint32)] * 2)
        np.savez(file, **places, **{f"{a} {b}": same for a, b in combinations(range(len(POSES)), 2)})

    monkeypatch.setattr(learned, "installed", lambda: True)
    monkeypatch.setattr(learned, "match_photos", match)
    found = find_cameras(tmp_path, nothing)
    assert found["learned"] and found["placed"] == len(POSES) and found["error"] < 0.1
    assert {path.name for path in (tmp_path / "sparse").iterdir()} == {"0"}
    distances, angles = pose_errors(read_capture(tmp_path).views, POSES)
    assert distances.max() < 0.01 and angles.max() < 0.1


def test_learned_matches_of_a_room_that_stands_still(tmp_path, monkeypatch):
    """Check that cameras are found from the pixels in the masks, where cameras that follow the room explain nearly all matches.

    Here all pairs of photos but one follow the room, in which the camera moves the other way round.
    """
    noise(tmp_path, len(POSES))
    for number in range(len(POSES)):
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[HEIGHT // 4 :] = 255
        write(tmp_path / "masks" / f"{number}.png", mask)
    points = np.random.default_rng(1).uniform([-0.6, -0.6, -0.2], [0.6, 0.6, 1], (300, 3))

    def match(photos, masks, file, progress) -> None:
        object_and_room = [
            np.concatenate([project(points, p) for p in both]) for both in zip(POSES, POSES[::-1], strict=True)
        ]
        places = {f"{n}": pixels.astype(np.float32) for n, pixels in enumerate(object_and_room)}
        matched = np.column_stack([np.arange(300, dtype=np.uint32)] * 2)
        pairs = {f"{a} {b}": matched + 300 * (not masks) for a, b in combinations(range(len(POSES)), 2)}
        np.savez(file, **places, **pairs | {"0 7": matched})

    monkeypatch.setattr(learned, "installed", lambda: True)
    monkeypatch.setattr(learned, "match_photos", match)
    found = find_cameras(tmp_path, nothing)
    assert found["learned"] and found["inside"] and found["placed"] == len(POSES)
    distances, angles = pose_errors(read_capture(tmp_path).views, POSES)
    assert distances.max() < 0.01 and angles.max() < 0.1


def test_sift_is_enough(tmp_path, monkeypatch):
    """Check that learned features are not tried where SIFT places all photos."""
    for number, pose in enumerate(POSES[:4]):
        write(tmp_path / f"{number}.png", speckled(pose)[0])
    monkeypatch.setattr(learned, "installed", lambda: True)
    monkeypatch.setattr(learned, "match_photos", None)
    found = find_cameras(tmp_path, nothing)
    assert found["placed"] == 4 and not found["learned"]


def test_a_search_that_learned_features_may_help_says_how_to_install_them(tmp_path, monkeypatch):
    noise(tmp_path, 4)
    monkeypatch.setattr(learned, "installed", lambda: False)
    with pytest.raises(InputError, match=r"only 0 of 4.*learned features.*-m pip install --no-deps kornia==") as error:
        find_cameras(tmp_path, nothing)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("turns", range(4))
def test_features_of_a_photo_held_sideways_are_of_the_photo_as_stored(tmp_path, monkeypatch, turns):
    """Check where features are written: in pixels of the full photo, as stored, and only those inside the masks."""
    width, height = 2 * learned.SIDE, learned.SIDE
    picture = np.full((height, width, 3), 40, np.uint8)
    picture[200:202, 600:602] = 255
    write_as_phone(tmp_path / "photo.png", picture, turns, 30)
    mask = np.zeros((height, width), np.uint8)
    mask[:, :1000] = 255
    write(tmp_path / "mask.png", mask)
    many = np.concatenate([[[300.0, 100.0]], np.tile([[20.0, 20.0]], (learned.LEAST, 1)), [[700.0, 100.0]]])  # reduced

    def detect(images):
        assert tuple(images.shape) == (1, 3, height // 2, width // 2) and images[0, 0, 100, 300] == 1
        scores = torch.linspace(1, 0.5, len(many))
        return [
            SimpleNamespace(
                keypoints=torch.tensor(many), descriptors=torch.zeros(len(many), 128), keypoint_scores=scores
            )
        ]

    def match(data):
        count = data["image0"]["keypoints"].shape[1]
        assert count == len(many) - 1  # one is outside the mask
        return {"matches": [torch.arange(count)[:, None].repeat(1, 2)]}

    monkeypatch.setattr(learned, "_load_networks", lambda: (detect, match))
    photos, file = [tmp_path / "photo.png"] * 2, tmp_path / "matches.npz"
    learned.match_photos(photos, [tmp_path / "mask.png"] * 2, file, nothing)
    places, pairs = learned.read_matches(file)
    assert set(places) == {0, 1} and pairs[0, 1].tolist() == [[n, n] for n in range(len(many) - 1)]
    stored = np.rot90(read_image(photos[0])[0], read_header(photos[0]).turns)
    x, y = places[0][0]  # the centre of the white square, whose first corner is at (600, 200)
    assert (stored[int(y - 1) : int(y + 1), int(x - 1) : int(x + 1)] == 255).all()


@pytest.mark.skipif(not learned.installed(), reason="learned features are not installed")
def test_learned_matches_agree_with_the_cameras(tmp_path):
    poses = POSES[:3:2]
    for number, pose in enumerate(poses):
        write(tmp_path / f"{number}.png", speckled(pose)[0])
    file = tmp_path / "matches.npz"
    learned.match_photos([tmp_path / "0.png", tmp_path / "1.png"], [], file, nothing)
    places, pairs = learned.read_matches(file)
    rays = [(places[n] - [WIDTH / 2, HEIGHT / 2]) / FOCAL for n in range(2)]
    one, other = (np.linalg.inv(pose @ OPENGL_TO_OPENCV) for pose in poses)
    matched = pairs[0, 1]
    far = FOCAL * epipolar_distance(rays[0][matched[:, 0]], rays[1][matched[:, 1]], (other @ np.linalg.inv(one))[:3])
    assert len(matched) > 50 and np.median(far) < 0.5 and np.quantile(far, 0.9) < 2
