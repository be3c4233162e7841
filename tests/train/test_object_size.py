"""Test how large the object is taken to be in the photos, and how many surfels it may have for that."""

import math

import pytest

from refgs.settings import load_settings
from refgs.train.decide.object_size import object_size, surfel_budget
from tests.makers.training import trainer

MANY = ["surfels.start=100", "surfels.budget=100000"]


def test_the_area_is_that_of_the_masks_and_at_most_that_of_the_region(sharp_ball, tmp_path):
    size = object_size(trainer(sharp_ball, tmp_path / "run").state)
    assert size.area == pytest.approx(math.pi / 4 * size.span**2, rel=0.05)  # a ball
    region = ["region.centre=[0.0,0.0,0.9]", "region.size=[0.2,0.2,0.2]"]
    assert 0 < object_size(trainer(sharp_ball, tmp_path / "part", *region).state).area < size.area / 4


def test_a_larger_object_gets_more_surfels_within_limits():
    settings = load_settings("standard", ["surfels.density=0.5", *MANY]).surfels
    assert [surfel_budget(settings, area) for area in (0, 300, 2000, 1e9)] == [200, 200, 1000, 100000]
    assert surfel_budget(load_settings("standard", ["surfels.density=0", *MANY]).surfels, 300) == 100000


def test_the_budget_and_its_reason_are_recorded(sharp_ball, tmp_path):
    state = trainer(sharp_ball, tmp_path / "run", *MANY, "surfels.density=0.5").state
    area = object_size(state).area
    assert state.settings.surfels.budget == round(area / 2) < 100000
    assert f"{area:,.0f} pixels" in state.effective.changes["surfels.budget"].why
