"""Test points that are triangulated from photos with known cameras: they lie on the plane that the photos show."""

import cv2
import numpy as np
import pytest

from refgs.capture import read_capture
from refgs.capture.backdrop import find_plane
from refgs.capture.region import up_direction
from refgs.capture.triangulate import neighbours, triangulate
from tests.makers.captures import CENTRE, edit, nerfstudio, ring, write

WIDTH, HEIGHT, FOCAL, COUNT = 240, 180, 260.0, 12
DEPTH = 0.5  # of the table below CENTRE


@pytest.fixture
def table(tmp_path):
    """Write photos of a flat table with a random pattern, which a camera goes around. Return the capture's folder."""
    random = np.random.default_rng(0)
    pattern = cv2.resize(random.integers(0, 255, (90, 90, 3), np.uint8), (900, 900), interpolation=cv2.INTER_CUBIC)
    poses = ring(COUNT)
    nerfstudio(tmp_path, poses=poses)
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    for i, pose in enumerate(poses):
        rays = np.stack([u / FOCAL, -v / FOCAL, -np.ones_like(u)], -1) @ pose[:3, :3].T
        along = (CENTRE[2] - DEPTH - pose[2, 3]) / np.minimum(rays[..., 2], -1e-3)
        at = pose[:2, 3] + along[..., None] * rays[..., :2] - CENTRE[:2]
        x, y = (100 * at + 450).astype(np.float32).transpose(2, 0, 1)
        photo = cv2.remap(pattern, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        photo[rays[..., 2] > -1e-3] = 0
        write(tmp_path / "images" / f"{i:04d}.png", photo)
    lens = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    edit(tmp_path / "transforms.json", lambda data: data.update(lens))
    return tmp_path


def test_the_table_is_found_by_triangulated_points(table):
    capture, heard = read_capture(table), []
    points = triangulate(capture.views, lambda *counts: heard.append(counts))
    assert heard[-1] == (COUNT, COUNT) and len(points) > 100
    height = (points @ capture.to_capture[:3, :3].T + capture.to_capture[:3, 3])[:, 2] - CENTRE[2]
    assert np.quantile(np.abs(height + DEPTH), 0.9) < 0.02
    positions = np.array([view.camera.position for view in capture.views])
    plane = find_plane(points, capture.centre, 0.6 * capture.radius, up_direction(capture.views), positions)
    assert plane.normal[2] > 0.99
    foot = plane.distance * plane.normal @ capture.to_capture[:3, :3].T + capture.to_capture[:3, 3]
    assert abs(foot[2] - CENTRE[2] + DEPTH) < 0.03


def test_photos_without_texture_have_no_points(tmp_path):
    nerfstudio(tmp_path, poses=ring(6))
    for path in (tmp_path / "images").iterdir():
        write(path, np.full((48, 64, 3), 128, np.uint8))
    assert triangulate(read_capture(tmp_path).views, lambda *_: None).shape == (0, 3)


def test_each_photo_is_matched_with_near_ones(table):
    pairs = neighbours([view.camera for view in read_capture(table).views])
    assert {i for pair in pairs for i in pair} == set(range(COUNT)) and all(a < b for a, b in pairs)
    assert np.mean([min(b - a, COUNT - b + a) for a, b in pairs]) < 4
