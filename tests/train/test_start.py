"""Where surfels start when nothing is masked."""

import dataclasses

import numpy as np

from refgs.capture import load_view, read_capture
from refgs.settings import load_settings
from refgs.train.start import FAINT, start_parameters
from tests.capture.makers import colmap


def start(folder, points: int, count: int = 1000):
    capture = read_capture(colmap(folder))
    rng = np.random.default_rng(0)
    capture = dataclasses.replace(
        capture, points=rng.normal(size=(points, 3)), point_colors=np.full((points, 3), [1.0, 0.5, 0.0])
    )
    views = [load_view(view) for view in capture.views]
    parameters, said = start_parameters(capture, views, load_settings("quick", [f"surfels.start={count}"]))
    position = parameters["position"].detach().numpy()
    assert all(p.isfinite().all() for p in parameters.values())
    assert parameters["opacity"].sigmoid().max() <= FAINT + 1e-6
    return capture, position, parameters["sh_dc"].detach().numpy(), said


def test_enough_structure_from_motion_points_are_all_there_is(tmp_path):
    capture, position, _, said = start(tmp_path, 700)
    np.testing.assert_allclose(position, capture.points, atol=1e-6)
    assert "700 structure-from-motion points" in said


def test_few_points_are_joined_by_random_ones_for_the_surroundings(tmp_path):
    capture, position, colour, said = start(tmp_path, 200)
    assert "200 structure-from-motion points and 300 random ones" in said
    np.testing.assert_allclose(position[:200], capture.points, atol=1e-6)
    distance = np.linalg.norm(position[200:] - capture.centre, axis=1) / capture.radius
    assert (distance > 1).mean() == 0.5 and distance.max() < 11
    np.testing.assert_allclose(colour[200:], colour[:1].repeat(300, axis=0), atol=1e-6)


def test_without_points_they_are_random(tmp_path):
    capture, position, _, said = start(tmp_path, 20)
    assert "random points" in said and len(position) == 1000
    distance = np.linalg.norm(position - capture.centre, axis=1) / capture.radius
    assert (distance > 1).mean() == 0.5
