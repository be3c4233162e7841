"""Test that a training starts on reduced photos where the object is large enough, and that large photos are held once."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from refgs import train_job
from refgs.asked import Asked
from refgs.capture import cached
from refgs.train.decide.object_size import object_size
from refgs.train.learn import coarse
from refgs.train.learn.coarse import Coarse
from refgs.train.learn.poses import Poses
from refgs.train.plan import FULL
from tests.makers.training import check_equal, trainer

FEW = ["train.checkpoint_every=1000", "needs.specular=on"]


@pytest.fixture(scope="module")
def ball_capture(sharp_ball):
    """Use sharper photos than other tests, because they are reduced."""
    return sharp_ball


@pytest.fixture
def large(monkeypatch):
    """Let the objects of small test captures count as large."""
    monkeypatch.setattr(coarse, "LEAST_SPAN", 10)


@pytest.mark.parametrize(
    "pixels, factors",
    [(64, [1]), (399, [1]), (400, [2, 1]), (799, [2, 1]), (800, [4, 2, 1])],
)
def test_photos_are_reduced_as_long_as_the_object_stays_large(pixels, factors):
    found = coarse.stages(pixels)
    assert [stage.factor for stage in found] == factors
    assert [stage.until for stage in found] == sorted(stage.until for stage in found) and found[-1] == FULL[0]


def test_a_small_object_is_trained_on_full_photos(ball_capture, tmp_path):
    state = trainer(ball_capture, tmp_path / "run").state
    assert state.part(Coarse).factor == 1 and state.part(Coarse).stages == FULL
    assert 30 < object_size(state).span < 64


def test_where_the_object_is_not_known_photos_are_full(ball_capture, tmp_path, large):
    """Check that photos without masks are not reduced, and that a small region in a large object counts as small."""
    state = trainer(ball_capture, tmp_path / "run").state
    assert state.part(Coarse).factor > 1
    state.views[3] = replace(state.views[3], alpha=None)
    assert object_size(state).span == 0
    small = ["region.centre=[0.0,0.0,0.9]", "region.size=[0.2,0.2,0.2]"]
    assert 0 < object_size(trainer(ball_capture, tmp_path / "part", *small).state).span < 20


def test_each_stage_has_its_photos_and_decisions_see_full_ones(ball_capture, tmp_path, large, monkeypatch):
    made = trainer(ball_capture, tmp_path / "run", *FEW, total=40)
    seen = []
    whole = made.state.picture
    monkeypatch.setattr(made.state, "picture", lambda i, camera, *a: seen.append(camera) or whole(i, camera, *a))
    factors = []
    while not made.state.ended:
        seen.clear()
        made.step()
        factor = made.state.part(Coarse).factor
        factors.append(factor)
        view = next(v for v in made.state.views if v.camera.name == seen[0].name)
        assert seen[0].fx == pytest.approx(view.camera.fx / factor)
        assert made.state.photo(0, whole=True).image.shape[0] == 64
        assert coarse.photo(made.state, 0, whole=True).image.shape[0] == 64 // factor
    assert factors == [4] * 14 + [2] * 14 + [1] * 12


def test_reduced_photos_have_crops_of_their_own(ball_capture, tmp_path, large):
    state = trainer(ball_capture, tmp_path / "run", "needs.outside=off", total=40).state
    assert state.crops is not None and state.part(Coarse).crops is not None
    photo = coarse.photo(state, 0, whole=False)
    assert photo.whole == (16, 16) and photo.image.shape[0] <= 16


def test_photos_are_never_reduced_again(ball_capture, tmp_path, large):
    """Check that a training stays on full photos if its number of iterations rises after they were reached."""
    made = trainer(ball_capture, tmp_path / "run", *FEW, total=20)
    for _ in range(16):
        made.step()
    made.state.total = 40
    made.step()
    assert made.state.part(Coarse).factor == 1


@pytest.mark.parametrize("stop", [10, 20, 30])
def test_resumed_in_every_stage_it_is_the_same_training(ball_capture, tmp_path, large, stop):
    folder = tmp_path / "run"
    first = trainer(ball_capture, folder, *FEW, total=40)
    first.run(lambda: first.state.iteration == stop)
    second = trainer(ball_capture, folder, *FEW, total=40)
    second.resume()
    assert (second.state.part(Coarse).factor == 1) == (stop == 30)
    for made in (first, second):
        made.run()
    check_equal(first, second)


def test_a_moved_camera_moves_that_of_the_reduced_photo(ball_capture, tmp_path, large):
    state = trainer(ball_capture, tmp_path / "run", total=40).state
    given = state.part(Poses).given
    given[0] = given[1]
    state.part(Poses).move(state, 0)
    for photo, side in ((state.photos[0], 64), (state.part(Coarse).photos[0], 16)):
        assert photo.camera.name == given[1].name and photo.camera.width == side
        np.testing.assert_array_equal(photo.camera.world_to_camera, given[1].world_to_camera)


def test_iterations_on_reduced_photos_cost_less(ball_capture, tmp_path, large):
    state = trainer(ball_capture, tmp_path / "run", total=100).state
    half = state.part(coarse.Coarse).stages[-2].cost
    assert 0.25 < half < 1
    assert coarse.cost(state, 70, 100) == pytest.approx(30) and coarse.cost(state, 40, 50) == pytest.approx(10 * half)
    assert coarse.cost(state, 0, 100) == pytest.approx(coarse.cost(state, 0, 40) + coarse.cost(state, 40, 100))


def test_large_photos_are_held_once_and_leave_no_files(ball_capture, tmp_path, large, monkeypatch):
    """Check that photos of a large capture are only in mapped files. They stay for resuming, and go with the training's end.

    A training on mapped photos learns the same as one on photos in memory.
    """
    few = [*FEW, "train.iterations=20", "surfels.start=600", "surfels.budget=800", "surfels.hull=48"]

    def train(folder, resume=False, until=1000):
        asked = Asked(ball_capture, folder, "quick", "cpu", changes=tuple(few))
        asked = asked.resumed() if resume else asked
        return train_job.train(asked, lambda event, facts: None, lambda state: state.iteration == until)[0]

    held = train(tmp_path / "held")
    monkeypatch.setattr(cached, "LARGE", 0)
    state = train(tmp_path / "run", until=4)
    files = sorted(file.name for file in (tmp_path / "run" / "photos").iterdir())
    assert len(files) > 2 * len(state.views)
    for photo, view in zip(state.photos, state.views, strict=True):
        assert photo.image.data_ptr() == view.image.ctypes.data and photo.mask.data_ptr() == view.alpha.ctypes.data
        for array in (view.image, view.alpha):
            assert isinstance(array.base, np.memmap)
    monkeypatch.setattr(cached, "load_view", None)  # the resumed training reads no photo
    state = train(tmp_path / "run", resume=True)
    assert state.ended and not (tmp_path / "run" / "photos").exists()
    for name, value in held.learned.items():
        torch.testing.assert_close(value, state.learned[name], rtol=0, atol=0)


def test_photos_that_could_not_all_be_read_leave_no_files(ball_capture, tmp_path, monkeypatch):
    monkeypatch.setattr(cached, "LARGE", 0)

    def broken(view, side):
        raise KeyboardInterrupt

    monkeypatch.setattr(cached, "load_view", broken)
    with pytest.raises(KeyboardInterrupt):
        train_job.train(Asked(ball_capture, tmp_path / "run", "quick", "cpu"), lambda *a: None, lambda s: False)
    assert not (tmp_path / "run" / "photos").exists()
