"""Test when surfels start in the hollows that photos see."""

import numpy as np
import pytest

from refgs.capture import read_capture
from refgs.effective import Effective
from refgs.settings import load_settings
from refgs.train.plan import Plan
from refgs.train.setup import set_up
from tests.makers.distances import around
from tests.makers.textured import bowl, carve_coarsely, photograph, write_capture

LID = 0.1  # of the radius, under the rim


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_capture(
        tmp_path_factory.mktemp("speckled") / "bowl", [photograph(camera, bowl) for camera in around(40, 96)]
    )


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    carve_coarsely(monkeypatch)


def start(folder, run, *changes: str) -> tuple[np.ndarray, str]:
    """Return the positions of the first surfels on the surface, and what the user is told of them."""
    said = []
    settings = Effective.of(load_settings("quick", ["surfels.start=2000", "surfels.inside=0", *changes]))
    state = set_up(read_capture(folder), settings, run, lambda *event: said.append(str(event)), Plan(None), "cpu")
    return state.learned["position"].detach().numpy(), next(one for one in said if "surfels start" in one)


def on_lid(positions: np.ndarray) -> float:
    return float(np.mean((positions[:, 2] > -LID) & (np.linalg.norm(positions[:, :2], axis=1) < 0.6)))


def test_no_surfel_starts_on_a_lid_that_photos_see_through(folder, tmp_path):
    positions, said = start(folder, tmp_path, "light.frame=world")
    assert "less what photos see through" in said
    assert on_lid(positions) < 0.02


def test_the_lid_stays_under_a_light_that_turns_with_the_camera(folder, tmp_path):
    positions, said = start(folder, tmp_path, "light.frame=camera")
    assert "less" not in said
    assert on_lid(positions) > 0.1
