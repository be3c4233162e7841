"""Test two settings: the box to reconstruct (`region`), and the up direction.

Both are given in the capture's own coordinates.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from refgs.capture import read_capture
from refgs.capture.box import Box
from refgs.errors import InputError
from refgs.settings import load_settings
from tests.makers.captures import CENTRE, RADIUS, colmap, nerf_blender, nerfstudio

UP = np.array([0.6, 0.0, 0.8])


def region(**numbers):
    """Make settings with a box to reconstruct (region). `numbers` are its values, for example `centre=(0, 0, 1)`."""
    changes = [f"region.{key}={list(map(float, value))}" for key, value in numbers.items()]
    return load_settings("quick", changes).region


def test_a_box_is_turned_as_blender_turns():
    box = Box.of(region(centre=(1, 2, 3), size=(4, 2, 6), rotation=(90, 0, 90)))
    # About x: y to z. Then about z: x to y. So the box's x is the capture's y, its y the capture's z, its z the capture's x.
    ends, centre = np.array([[0, 1.9, 0], [0, 0, 0.9], [2.9, 0, 0], [2.9, 1.9, -0.9]]), np.array([1, 2, 3])
    assert box.contains(centre + ends).all() and not box.contains(centre + 1.2 * ends).any()
    assert box.contains(box.grid(3) * (1 - 1e-9) + centre * 1e-9).all() and len(box.grid(3)) == 27
    assert box.radius == pytest.approx(np.sqrt(4 + 1 + 9))


@pytest.mark.parametrize("make", [nerf_blender, nerfstudio, colmap])
def test_a_region_moves_nothing_and_up_turns_all(tmp_path, make):
    plain = read_capture(make(tmp_path))
    ball = np.linalg.inv(plain.to_capture) @ np.append(CENTRE + np.array([0, 0, RADIUS]), 1)
    scale = np.cbrt(np.linalg.det(plain.to_capture[:3, :3]))
    centre, size = ball[:3], [0.6 / scale] * 3
    capture = read_capture(tmp_path, region(centre=centre, size=size, rotation=(0, 0, 30)))
    assert capture.fingerprint() == plain.fingerprint()
    np.testing.assert_allclose(capture.to_capture, plain.to_capture, atol=1e-12)
    np.testing.assert_allclose(capture.box.centre, centre, atol=1e-9)
    turn = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    np.testing.assert_allclose(capture.box.matrix[:3, :3], 0.3 / scale * turn, atol=1e-9)
    assert capture.bounded and capture.reach > capture.radius
    assert np.linalg.norm(capture.centre - centre) <= capture.box.radius and capture.radius <= 1.1 * capture.box.radius
    if make is nerf_blender:
        assert capture.centre[2] < centre[2], "the masks show nothing in the box's upper half"

    tilted = read_capture(tmp_path, region(centre=centre, size=size, rotation=(0, 0, 30), up=3 * UP))
    turn = np.linalg.inv(plain.to_capture) @ tilted.to_capture  # from the new run frame to the one without `up`
    np.testing.assert_allclose(turn[:3] @ (0, 0, 1, 0), UP, atol=1e-9)
    np.testing.assert_allclose(turn[:3, :3] @ turn[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.abs(turn[:3, 3]).max() < 1e-9
    for one, other in zip(capture.views, tilted.views, strict=True):
        np.testing.assert_allclose(turn @ other.camera.camera_to_world, one.camera.camera_to_world, atol=1e-9)
    np.testing.assert_allclose(turn @ tilted.box.matrix, capture.box.matrix, atol=1e-9)
    np.testing.assert_allclose(turn[:3, :3] @ tilted.centre, capture.centre, atol=1e-9)
    assert tilted.radius == pytest.approx(capture.radius) and tilted.reach == pytest.approx(capture.reach)
    if plain.points is not None:
        np.testing.assert_allclose(tilted.points @ turn[:3, :3].T, plain.points, atol=1e-9)


def test_up_as_it_is_already_changes_nothing(tmp_path):
    plain = read_capture(nerf_blender(tmp_path))
    capture = read_capture(tmp_path, region(up=(0, 0, 2)))
    assert np.array_equal(capture.to_capture, np.eye(4)) and capture.box is None
    for one, other in zip(plain.views, capture.views, strict=True):
        assert np.array_equal(one.camera.world_to_camera, other.camera.world_to_camera)
    assert (capture.radius, capture.reach) == (plain.radius, plain.radius)


def test_a_region_that_no_photo_shows(tmp_path):
    folder = nerf_blender(tmp_path)
    with pytest.raises(InputError, match="no photo shows the region") as error:
        read_capture(folder, region(centre=(0, 0, 100), size=(1, 1, 1)))
    assert "\n" not in str(error.value)
