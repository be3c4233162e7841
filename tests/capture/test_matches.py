"""Test features that photos have in common, against photos whose cameras are known exactly or are off by a known amount."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from refgs.camera import Camera
from refgs.capture import LoadedView
from refgs.capture.matches import LEAST_PAIRS, match_neighbours, pixels_apart
from tests.makers.captures import FLIP, ring
from tests.makers.films import speckled_ball

WIDTH, HEIGHT = 320, 240


@pytest.fixture(scope="module")
def views():
    found, poses = [], ring(60, distance=3.5)
    # Two of every six: each photo has one nearest neighbour, which rounding cannot exchange for another.
    for number, pose in enumerate(pose for i in range(0, 60, 6) for pose in (poses[i], poses[i + 2])):
        image, ball = speckled_ball(pose, WIDTH, HEIGHT)
        camera = Camera(
            name=f"{number:02}",
            width=WIDTH,
            height=HEIGHT,
            fx=1.1 * WIDTH,
            fy=1.1 * WIDTH,
            cx=WIDTH / 2,
            cy=HEIGHT / 2,
            world_to_camera=FLIP @ np.linalg.inv(pose),
        )
        found.append(LoadedView(image, (255 * ball).astype(np.uint8), camera))
    return found


def turned(views, degrees):
    """Turn each camera about itself by an angle of `degrees`, about a random axis."""
    axes = np.random.default_rng(0).normal(size=(len(views), 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    cameras = []
    for view, axis in zip(views, axes, strict=True):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix()
        cameras.append(replace(view.camera, world_to_camera=turn @ view.camera.world_to_camera))
    return cameras


def test_features_lie_on_the_epipolar_lines_of_exact_cameras(views):
    """Check also that the distance grows with the cameras' error: it doubles with it."""
    matches = match_neighbours(views)
    assert len(matches) >= LEAST_PAIRS
    assert pixels_apart(matches, [view.camera for view in views]) < 0.2
    once, twice = (pixels_apart(matches, turned(views, degrees)) for degrees in (0.5, 1.0))
    assert once > 0.4 and twice == pytest.approx(2 * once, rel=0.2)


def test_features_are_inside_the_masks(views):
    for pair in match_neighbours(views):
        for index, pixels in ((pair.first, pair.ours), (pair.second, pair.theirs)):
            column, row = np.floor(pixels).astype(int).T
            assert (views[index].alpha[row, column] == 255).all()


def test_photos_without_features_tell_nothing(views):
    plain = [replace(view, image=np.full_like(view.image, 90)) for view in views]
    assert match_neighbours(plain) == []
    assert pixels_apart([], [view.camera for view in plain]) is None
    assert pixels_apart(match_neighbours(views[:1]), [views[0].camera]) is None


def test_matches_by_chance_tell_nothing(views, monkeypatch):
    """Check matches at random places: some of them always fit an epipolar geometry, but most do not."""
    random, cameras = np.random.default_rng(0), [view.camera for view in views]
    descriptors = random.uniform(0, 255, (100, 128)).astype(np.float32)

    def anywhere(view):
        return random.uniform(0, [WIDTH, HEIGHT], (100, 2)), descriptors

    monkeypatch.setattr("refgs.capture.matches._features", anywhere)
    monkeypatch.setattr("refgs.capture.matches.LEAST", 8)
    assert pixels_apart(match_neighbours(views), cameras) is None
    monkeypatch.setattr("refgs.capture.matches.AGREEING", 0.0)
    assert pixels_apart(match_neighbours(views), cameras) > 5, "some fit, and contradict the cameras"
