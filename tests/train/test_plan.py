"""Test that a training with a given duration ends on time, however long an iteration takes."""

from types import SimpleNamespace

import numpy as np
import pytest

from refgs.train import plan, timeline
from refgs.train.plan import Plan, iterations_time

VIEWS = 40


class _Time:
    now = 1000.0

    def perf_counter(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch) -> _Time:
    clock = _Time()
    monkeypatch.setattr(plan, "time", clock)
    return clock


def _train(
    clock: _Time, made: Plan, pace, paused: float = 0.0, start: float = 12.0, first: int = 0, growth: float = 1.5
) -> tuple[int, float]:
    """Simulate a training that follows the plan `made`. Return the number of iterations and the seconds, without pauses.

    Preparing takes `start` seconds. Then iterations are counted from `first`, and `pace(iteration)` is the seconds that an iteration takes.
    At iteration 100 the training pauses for `paused` seconds. Writing the result at the end counts too.

    The plan expects the last iteration to take `growth` times as long as the first.
    """
    begun = clock.now
    clock.now += start
    made.begin(first, growth)
    iteration, total = first, 100_000
    while iteration < total:
        if paused and iteration == 100:
            clock.now += paused
            made.wait(paused)
        clock.now += pace(iteration)
        iteration += 1
        if timeline.PLAN.due(SimpleNamespace(plan=made, total=total), SimpleNamespace(done=iteration)):
            total = made.total(iteration, VIEWS) or total
    clock.now += pace(iteration) * made.end(VIEWS, pace(iteration))
    return iteration, clock.now - begun - paused


@pytest.mark.parametrize("minutes", [2, 5, 20])
@pytest.mark.parametrize(
    "pace",
    [lambda i: 0.1, lambda i: 0.05 + 0.1 * min(i / 1000, 1), lambda i: 0.2 if i < 300 else 0.1],
    ids=["even", "slower", "faster"],
)
def test_it_ends_on_time_whatever_an_iteration_takes(clock, pace, minutes):
    _, seconds = _train(clock, Plan(minutes), pace)
    assert seconds == pytest.approx(60 * minutes, rel=0.1)


def test_where_iterations_grow_slower_as_expected_their_number_is_known_at_once(clock):
    """Check that the planned number of iterations is right to 4 % from the start, if iterations slow down as predicted.

    Learning rates depend on this number, so it must hardly change during the training. It changes when an optional part of the end no
    longer pays.
    """
    made, asked = Plan(5), []
    whole = made.total

    def total(iteration: int, views: int) -> int | None:
        asked.append(whole(iteration, views))
        return asked[-1]

    made.total = total
    mean = iterations_time(2.0, 1.0) * 0.05
    count = 60 * 5 / mean
    steps = np.diff([iterations_time(2.0, min(k / count, 1)) * count for k in range(int(count) + 2)])
    done, _ = _train(clock, made, lambda i: 0.05 * steps[min(i, len(steps) - 1)], growth=2.0)
    known = [value for value in asked if value]
    assert len(known) > 50 and min(known) > 0.96 * done and max(known) < 1.04 * done


def test_a_pause_is_not_counted(clock):
    usual = _train(clock, Plan(2), lambda i: 0.1)
    assert _train(clock, Plan(2), lambda i: 0.1, paused=500.0) == pytest.approx(usual)


def test_what_was_spent_before_it_was_gone_on_with_is(clock):
    made = Plan(5)
    made.before = 60.0
    _, seconds = _train(clock, made, lambda i: 0.1, first=400)
    assert seconds == pytest.approx(240, rel=0.05)


def test_a_time_that_is_over_ends_it_at_once_and_none_never(clock):
    iterations, _ = _train(clock, Plan(0.05), lambda i: 0.1)
    assert iterations == 10
    assert Plan(None).total(50, VIEWS) is None
