"""Plan how many iterations fit into a given time, which includes setting up the training and writing its asset."""

import math
import time
from typing import NamedTuple

END_A_VIEW, END = 0.35, 15  # time for writing the asset, in iterations: for each photo that is rendered, and in all
# A part of the time given: if the program takes longer to start, a training starts with less detail, down to the fraction LEAST_DETAIL.
STARTS, LEAST_DETAIL = 0.05, 0.5
LEAST_VIEWS = 16  # of the photos that are rendered for the asset, if there is little time
DOUBT_A_VIEW, DOUBT = 0.8, 120  # time for measuring what photos leave open about metals, in iterations, as above
TRADES, FLIP = 20, 8  # time for measuring what light and materials can make up for, and FLIP, in iterations
# Parts of the time that is left, or of all iterations: an optional part of the training that takes more is left out. SHAPES is for what
# decides whether metals are metal and hollows are open: without it, much else is wrong.
PART, SHAPES = 0.1, 0.3
# Iterations slow down as surfels are divided and inter-reflection starts. The slowdown is linear between these parts of a training.
GROWS = 0.1, 0.3
OTHERS = 16_000  # number of surfels that takes as long as the rest of an iteration
OTHER_PIXELS = 32_000  # number of pixels of the object that takes as long as the rest of an iteration
A_ROUND = 1.25  # times as many surfels there are, at most, after each round of dividing
MIRRORED = 1.2  # factor on the time for inter-reflection: 1 without, 1.4 if much of the object mirrors itself


class Stage(NamedTuple):
    """Describe a training stage: until the progress `until`, photos' sides are divided by `factor`.

    `cost` is the time of an iteration relative to one on full photos.
    """

    until: float
    factor: int
    cost: float = 1.0


FULL = (Stage(1.0, 1),)


def by_pixels(area: float, scale: float) -> float:
    """Estimate how an iteration's time changes if the object covers `scale` times as many pixels of a photo; `area` is their number now."""
    return (OTHER_PIXELS + scale * area) / (OTHER_PIXELS + area)


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


def growth(first: int, last: int, rounds: float = math.inf) -> float:
    """Estimate by which factor iterations slow down until the end. Surfels grow from `first` to at most `last`, in `rounds` of dividing."""
    last = round(min(last, first * A_ROUND ** min(rounds, 100)))
    return MIRRORED * (OTHERS + max(last, first)) / (OTHERS + first)


def doubt(views: int) -> float:
    """Return the time for measuring what photos leave open about metals, in iterations."""
    return DOUBT_A_VIEW * views + DOUBT


class Plan:
    """Plan a training, asset included, to end within a given time, not counting pauses."""

    def __init__(self, minutes: float | None):
        """Start the clock. Without `minutes` there is no limit."""
        self.minutes, self._begun = minutes, time.perf_counter()
        self.before = 0.0  # seconds spent before the run was resumed
        self._growth, self._stages, self._marks = 1.0, FULL, [(0, 0.0)]
        self.pace = 0.0  # seconds that an iteration on full photos is expected to take at the end
        self.detail = 1.0  # how much detail there is time for at first, 1 if all
        # Optional parts that do not pay, and which fraction of the time each would take.
        self.left_out: dict[str, float] = {}

    @property
    def given(self) -> float:
        """Return the seconds that were given, infinite without a limit."""
        return math.inf if self.minutes is None else 60 * self.minutes

    def lower_detail(self, fits: float) -> float:
        """Lower and return `detail`, if only the fraction `fits` of what is wanted fits into the time."""
        self.detail = max(min(fits, self.detail), LEAST_DETAIL)
        return self.detail

    def pays(self, what: str, part: float, most: float = PART) -> bool:
        """Tell whether the fraction `part` of the time, for an optional part of the training, is at most `most`.

        If it is more, note that in `left_out`.
        """
        self.left_out.pop(what, None)  # the number of iterations may have changed since
        pays = self.minutes is None or part <= most
        self.left_out |= {} if pays else {what: part}
        return pays

    def pays_at_start(self, what: str, seconds: float, most: float = PART) -> bool:
        """Tell whether an optional part that takes `seconds` is worth the time that is left (see `pays`)."""
        return self.pays(what, seconds / max(self.given - self.spent, 1e-9), most)

    def end(self, views: int, pace: float) -> float:
        """Return how many iterations take as long as the end, if one takes `pace` seconds. The end evaluates, and writes the asset."""
        optional = doubt(views), TRADES, FLIP
        rendered = min(views, self.views_at_end(pace))
        return END_A_VIEW * rendered + END + sum(each for each in optional if each * pace <= PART * self.given)

    def views_at_end(self, pace: float | None = None) -> int:
        """Return how many views may be rendered for the asset. An iteration takes `pace` seconds, by default `self.pace`."""
        pace = self.pace if pace is None else pace
        return max(LEAST_VIEWS, round(min(PART * self.given / max(END_A_VIEW * pace, 1e-9), 1e9)))

    def pays_at_end(self, what: str, iterations: float) -> bool:
        """Tell whether an optional part of the end is worth its time, that of `iterations`, and whether so much time is left."""
        seconds = iterations * self.pace
        return self.pays(what, seconds / self.given if self.spent + seconds <= self.given else 1.0)

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
        pace, left = (now - then) / (iteration - half), self.given - now

        def seconds_left(total: int) -> float:
            """Estimate the seconds left, including the asset, for a training of `total` iterations."""
            whole, by_now, by_half = (
                iterations_time(self._growth, k / total, self._stages) * total for k in (total, iteration, half)
            )
            at_first = pace * (iteration - half) / (by_now - by_half)  # seconds that the first iterations took
            self.pace = at_first * self._growth
            return at_first * (whole - by_now) + self.pace * self.end(views, self.pace)

        low, high = iteration, 2 * iteration + int(2 * max(left, 0.0) / pace)
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if seconds_left(middle) <= left else (low, middle)
        return low
