"""Test how large the object is taken to be in the photos, and how many surfels, and texels of the light, it may have for that."""

import math

import pytest

from refgs.settings import load_settings
from refgs.train.decide import lighting
from refgs.train.decide.object_size import LEAST, light_resolution, object_size, surfel_limits
from tests.makers.training import trainer

MANY = ["surfels.start=100", "surfels.budget=100000"]


def test_the_area_is_that_of_the_masks_and_at_most_that_of_the_region(sharp_ball, tmp_path):
    size = object_size(trainer(sharp_ball, tmp_path / "run").state)
    assert size.area == pytest.approx(math.pi / 4 * size.span**2, rel=0.05)  # a ball
    region = ["region.centre=[0.0,0.0,0.9]", "region.size=[0.2,0.2,0.2]"]
    assert 0 < object_size(trainer(sharp_ball, tmp_path / "part", *region).state).area < size.area / 4


def test_a_larger_object_gets_more_surfels_within_limits():
    settings = load_settings(
        "standard", ["surfels.density=0.5", "surfels.start=30000", "surfels.budget=100000"]
    ).surfels
    limits = {
        0: (30000, 60000),
        300: (6667, LEAST),
        24000: (16000, 24000),
        90000: (30000, 60000),
        160000: (30000, 80000),
    }
    for area, expected in (limits | {1e9: (30000, 100000)}).items():
        assert surfel_limits(settings, area) == expected, area
    settings = load_settings("standard", ["surfels.density=0", *MANY]).surfels
    assert surfel_limits(settings, 300) == (100, 100000)


def test_the_light_is_as_fine_as_a_ball_shows_it():
    """Check the texels for balls whose radius is a quarter of the span: neighbouring pixels mirror directions 2 / radius apart, or more."""
    for finest, span, side in (
        (128, 220, 64),
        (128, 330, 128),
        (256, 700, 256),
        (256, 600, 128),
        (64, 100, 64),
        (128, 0, 128),
    ):
        assert light_resolution(finest, span) == side, (finest, span)
        if span and side > 64:
            assert math.pi / 2 / (side // 2) > 2 / (span / 4), "half as many would be seen"


def test_the_limits_and_their_reasons_are_recorded(sharp_ball, tmp_path):
    large = ["surfels.start=30000", "surfels.budget=100000", "environment.resolution=128"]
    settings, changes = {}, {}
    for density in (0.0, 0.5):
        state = trainer(sharp_ball, tmp_path / f"{density}", *large, f"surfels.density={density}").state
        settings[density], changes[density] = state.settings, state.effective.changes
    limited = settings[0.5]
    assert (limited.surfels.budget, limited.surfels.start, limited.environment.resolution) == (LEAST, 6667, 64)
    size = object_size(state)
    assert f"{size.area:,.0f} pixels" in changes[0.5]["surfels.budget"].why
    assert f"{size.span:,.0f} pixels" in changes[0.5]["environment.resolution"].why
    assert settings[0.0].surfels.start == 30000 and settings[0.0].environment.resolution == 128
    assert len(state.learned["position"]) <= 6667
    state.change("environment.resolution", 16, "needs", "nothing is mirrored")
    lighting.Light().undo(state, "a look at the photos")
    assert state.settings.environment.resolution == 64
