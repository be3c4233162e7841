"""Test how a training starts: where surfels are placed in captures without masks, and how bright the light is."""

import dataclasses

import numpy as np
import pytest
import torch

from refgs.capture import load_view, read_capture
from refgs.color import srgb_decode, srgb_encode
from refgs.model import harmonics
from refgs.settings import load_settings
from refgs.train.learn.light import start_value
from refgs.train.start import FAINT, start_parameters
from tests.makers.captures import colmap
from tests.makers.training import trainer


def start(folder, points: int, count: int = 1000):
    capture = read_capture(colmap(folder))
    rng = np.random.default_rng(0)
    capture = dataclasses.replace(
        capture, points=rng.normal(size=(points, 3)), point_colors=np.full((points, 3), [1.0, 0.5, 0.0])
    )
    views = [load_view(view) for view in capture.views]
    start = start_parameters(capture, views, load_settings("quick", [f"surfels.start={count}"]))
    parameters, said = start.parameters, start.said
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


def test_the_light_starts_no_brighter_than_the_photos(large_ball, tmp_path):
    """Check that a surface of base colour 1/3 is lit like photos that are darker by four stops, and by eight."""
    state = trainer(large_ball, tmp_path / "run").state
    before = [photo.image for photo in state.photos]
    means = []
    for stops in (0, 4, 8):
        shown = pixels = 0.0
        for view, (photo, image) in enumerate(zip(state.photos, before, strict=True)):
            linear = srgb_decode(image.float() / 255) / 2**stops
            image = (srgb_encode(linear) * 65535).round().to(torch.uint16)
            state.photos[view] = photo._replace(image=image, white=65535)
            shown += float((linear.mean(dim=-1) * photo.mask / 255).sum())
            pixels += float(photo.mask.float().sum()) / 255
        means.append(shown / pixels)
        assert float(start_value(state).exp()) == pytest.approx(min(0.5, 3 * means[-1]), rel=0.02)
    assert means[0] > 0.25 > 0.05 > means[1] > means[2]
    state.photos[:] = [photo._replace(image=torch.zeros_like(photo.image)) for photo in state.photos]
    assert 0 < float(start_value(state).exp()) < 0.01
