"""Plan how many iterations fit into a given time, which includes setting up the training and writing its asset."""

import time
from typing import NamedTuple

END_A_VIEW, END = 0.5, 20  # time for writing the asset, in iterations: for each photo that is rendered, and in all
# Iterations slow down as surfels are divided and inter-reflection starts. The slowdown is linear between these parts of a training.
GROWS = 0.1, 0.3
OTHERS = 16_000  # number of surfels that takes as long as the rest of an iteration
BY_PIXELS = 0.8  # an iteration's time grows with the number of pixels to this power: 0.7 to 0.9 on three captures
MIRRORED = 1.2  # factor on the time for inter-reflection: 1 without, 1.4 if much of the object mirrors itself


class Stage(NamedTuple):
    """Describe a training stage: until the progress `until`, photos' sides are divided by `factor`."""

    until: float
    factor: int

    @property
    def cost(self) -> float:
        """Return the time of an iteration relative to one on full photos."""
        return self.factor ** (-2 * BY_PIXELS)


FULL = (Stage(1.0, 1),)


def iterations_time(growth: float, progress: float, stages: tuple[Stage, ...] = FULL) -> float:
    """Compute how long all iterations up to a progress of 0..1 take together.

    The unit is the time that the whole training would take if each iteration were as fast as the first one on full photos. But iterations
    slow down: the last takes `growth` times as long as the first, if both are on full photos.
    """
    first, last = GROWS

    def full(progress: float) -> float:
        ramp = min(max(progress - first, 0.0), last - first)
        more = ramp**2 / (2 * (last - first)) + max(progress - last, 0.0)
        return progress + (growth - 1) * more

    total, begun = 0.0, 0.0
    for stage in stages:
        end = progress if stage.until == 1 else min(progress, stage.until)
        total += stage.cost * (full(max(end, begun)) - full(begun))
        begun = max(end, begun)
    return total


def growth(first: int, last: int) -> float:
    """Estimate by which factor iterations slow down until the end, from `first` to `last` surfels."""
    return MIRRORED * (OTHERS + max(last, first)) / (OTHERS + first)


class Plan:
    """Plan a training, asset included, to end within a given time, not counting pauses."""

    def __init__(self, minutes: float | None):
        """Start the clock. Without `minutes` there is no limit."""
        self.minutes, self._begun = minutes, time.perf_counter()
        self.before = 0.0  # seconds spent before the run was resumed
        self._growth, self._stages, self._marks = 1.0, FULL, [(0, 0.0)]

    @property
    def spent(self) -> float:
        """Return the seconds since the command started, plus those before the run was resumed."""
        return self.before + time.perf_counter() - self._begun

    def wait(self, seconds: float) -> None:
        """Exclude `seconds`, during which the training has paused, from the time spent."""
        self._begun += seconds

    @property
    def first(self) -> int:
        """Return the iteration at which `begin` was called."""
        return self._marks[0][0]

    def begin(self, iteration: int, growth: float, stages: tuple[Stage, ...] = FULL) -> None:
        """Start measuring the pace of iterations.

        The last iteration is expected to take `growth` times as long as the first, if both are on full photos. `stages` are all stages of
        the training. `iteration` is the one that comes next.
        """
        self._growth, self._stages, self._marks = growth, stages, [(iteration, self.spent)]

    def total(self, iteration: int, views: int) -> int | None:
        """Choose the total number of iterations so that the training ends in time.

        The choice depends on how long iterations have taken since `begin`. Without a time limit, returns None. `views` is the number of
        photos. They count because writing the asset renders all of them.
        """
        if self.minutes is None:
            return None
        done = iteration - self.first
        # The pace of the later half predicts best, and includes densification and meshes at their usual share.
        half, then = next(mark for mark in reversed(self._marks) if mark[0] <= iteration - done / 2)
        now = self.spent
        self._marks.append((iteration, now))
        pace, left = (now - then) / (iteration - half), 60 * self.minutes - now

        def seconds_left(total: int) -> float:
            """Estimate the seconds left, including the asset, for a training of `total` iterations."""
            whole, by_now, by_half = (
                iterations_time(self._growth, k / total, self._stages) * total for k in (total, iteration, half)
            )
            at_first = pace * (iteration - half) / (by_now - by_half)  # seconds that the first iterations took
            return at_first * (whole - by_now + self._growth * (END_A_VIEW * views + END))

        low, high = iteration, 2 * iteration + int(2 * max(left, 0.0) / pace)
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if seconds_left(middle) <= left else (low, middle)
        return low
