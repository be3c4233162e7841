"""Test the timeline: each row has an action, is due when it says, and the page about them is the program's."""

import pytest

from refgs.train import timeline
from refgs.train.timeline import AFTER, BEFORE, Every, Row, Step, iteration, part, period
from refgs.train.trainer import ACTIONS
from scripts import timeline_page
from tests.makers.training import TINY, trainer


@pytest.fixture(scope="module")
def state(ball_capture, tmp_path_factory):
    return trainer(ball_capture, tmp_path_factory.mktemp("runs") / "ball", *TINY, total=100).state


def due(row, state, progress, done) -> bool:
    step = Step(state)
    step.progress, step.done = progress, done
    return row.due(state, step)


def test_each_row_has_an_action_of_its_own():
    names = [row.what for row in (*BEFORE, *AFTER)]
    assert len(names) == len({*names}) and {*names} == {*ACTIONS}


def test_a_row_is_due_from_until_every_and_only_if(state):
    row = Row("a", part(0.2), part(0.5), Every("10", lambda state: 10))
    assert [done for done in range(101) if due(row, state, done / 100, done)] == [20, 30, 40]
    assert not due(row._replace(every=Every("never", lambda state: 0)), state, 0.3, 30)
    assert due(row._replace(only_if=timeline.LIT & iteration(30)), state, 0.3, 30)
    assert not due(row._replace(only_if=timeline.LIT & iteration(31)), state, 0.3, 30)
    assert not due(row._replace(only_if=timeline.INITIAL), state, 0.3, 30)


def test_times_follow_the_settings(state):
    every = state.settings.densify.every
    row = Row("a", every=period("densify.every"))
    assert due(row, state, 0.3, every) and not due(row, state, 0.3, every - 1)
    state.change("densify.every", 7, "plan", "the test says so")
    assert due(row, state, 0.3, 7) and not due(row, state, 0.3, 8)


@pytest.mark.parametrize("key", ["densify.every", "indirect.every"])
def test_a_setting_does_not_change_when_something_else_is_decided(ball_capture, tmp_path, key):
    """Check that exposures are judged at the same iterations, however often surfels are divided or meshes made."""
    state = trainer(ball_capture, tmp_path / "run", *TINY, total=100).state
    (row,) = (row for row in AFTER if row.what == "leave out exposures that agree")
    found = []
    for every in (7, 13):
        state.change(key, every, "plan", "the test says so")
        found.append([done for done in range(101) if due(row, state, done / 100, done)])
    assert found[0] == found[1] == [*range(30, 101, 5)]


def test_the_iteration_is_counted_when_it_is_over(ball_capture, tmp_path, monkeypatch):
    """Check that an iteration that fails halfway is not counted, so that it is done again from its start."""
    made = trainer(ball_capture, tmp_path / "run", *TINY, total=100)
    counts = []

    def fail(state, step):
        counts.append((state.iteration, step.done))
        raise RuntimeError

    monkeypatch.setitem(ACTIONS, "balance the exposures", fail)
    with pytest.raises(RuntimeError):
        made.step()
    assert counts == [(0, 1)] and made.state.iteration == 0
    monkeypatch.undo()
    made.step()
    assert made.state.iteration == 1


def test_the_page_is_of_this_program():
    assert timeline_page.PAGE.read_text(encoding="utf-8") == timeline_page.page(), "run scripts/timeline_page.py"
