"""Test where the first surfels are placed in captures without masks."""

import dataclasses

import numpy as np

from refgs.capture import load_view, read_capture
from refgs.model import harmonics
from refgs.settings import load_settings
from refgs.train.start import FAINT, start_parameters
from tests.makers.captures import colmap


def start(folder, points: int, count: int = 1000):
    capture = read_capture(colmap(folder))
    rng = np.random.default_rng(0)
    capture = dataclasses.replace(
        capture, points=rng.normal(size=(points, 3)), point_colors=np.full((points, 3), [1.0, 0.5, 0.0])
    )
    views = [load_view(view) for view in capture.views]
    parameters, _, said = start_parameters(capture, views, load_settings("quick", [f"surfels.start={count}"]))
    position = parameters["position"].detach().numpy()
    assert all(p.isfinite().all() for p in parameters.values())
    assert parameters["opacity"].sigmoid().max() <= FAINT + 1e-6
    return capture, position, parameters["sh_dc"].detach().numpy(), said


def test_enough_structure_from_motion_points_are_all_there_is(tmp_path):
    capture, position, colour, said = start(tmp_path, 700)
    np.testing.assert_allclose(position, capture.points, atol=1e-6)
    np.testing.assert_allclose(colour[:, 0] * harmonics.DC + 0.5, capture.point_colors, atol=1e-6)
    assert "700 structure-from-motion points" in said


def test_without_points_they_are_random(tmp_path):
    capture, position, _, said = start(tmp_path, 20)
    assert "random points" in said and len(position) == 1000
    assert np.linalg.norm(position - capture.centre, axis=1).max() <= capture.radius
