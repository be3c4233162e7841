"""Test multi-view stereo on shapes whose depth is known."""

import numpy as np
import pytest

from refgs.geometry import stereo
from refgs.geometry.stereo import depth_maps
from tests.makers.distances import around, depth, sphere
from tests.makers.textured import bowl, grid, half_ball, photograph

VIEWS = around(48, 96)


def errors(photos, shape, sdf, least: float = 0.5) -> tuple[np.ndarray, float]:
    """Return the errors of depths that count for at least `least`, and the part of the object's pixels that they are."""
    off, seen = [], 0
    for found in depth_maps(photos, shape, shape.solid):
        true, hit = depth(found.camera, sdf)
        chosen = (found.weight >= least) & (hit > 0)
        off.append(np.abs(found.depth - true)[chosen])
        seen += (hit > 0).sum()
    off = np.concatenate(off)
    return off, len(off) / seen


@pytest.fixture(scope="module")
def in_bowl():
    return [photograph(camera, bowl) for camera in VIEWS]


def test_depths_inside_a_bowl_are_found_behind_its_lid(in_bowl):
    off, part = errors(in_bowl, grid(half_ball), bowl)
    assert part > 0.4
    assert np.median(off) < 0.02  # a step between planes is 0.05
    assert np.quantile(off, 0.9) < 0.08


def test_errors_fall_with_the_distance_of_planes(in_bowl, monkeypatch):
    """Check the median error of all pixels, also of those that would not count: those that do are near some plane anyway."""
    monkeypatch.setattr(stereo, "SCORES", (-0.5, 0.9))
    monkeypatch.setattr(stereo, "AGREE", 0)
    found = []
    for planes in (12, 24, 48):
        monkeypatch.setattr(stereo, "PLANES", planes)
        monkeypatch.setattr(stereo, "APART", 1)
        found.append(np.median(errors(in_bowl, grid(half_ball), bowl, least=1e-4)[0]))
    assert found[1] < 0.65 * found[0]
    assert found[2] < 0.65 * found[1]


def test_what_has_no_texture_tells_no_depth():
    photos = [photograph(camera, sphere, contrast=0.01) for camera in VIEWS]
    assert errors(photos, grid(sphere), sphere)[1] < 0.02


def test_only_pixels_that_enter_where_asked_count(in_bowl):
    shape = grid(half_ball)
    nowhere = np.zeros_like(shape.solid)
    assert all(not found.weight.any() for found in depth_maps(in_bowl, shape, nowhere))


def test_views_too_far_apart_have_no_maps(in_bowl):
    assert depth_maps(in_bowl[::12], grid(half_ball), grid(half_ball).solid) == []
