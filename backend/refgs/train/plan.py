"""How many iterations fit into the time that a training was given, its start and its end included."""

import time

EVERY = 50  # iterations
FIRST = 10  # iterations, after which the pace is known well enough to say how many there are to be
# Iterations' time that writing the asset takes: for each photo, from all of which surfels are looked at, and besides.
END_A_VIEW, END = 0.5, 20
# An iteration takes longer while surfels are divided and what they mirror of each other is traced: from the first of these parts of a
# training to the second, in a straight line.
GROWS = 0.1, 0.3
OTHERS = 16_000  # surfels that take as long as what an iteration does besides
MIRRORED = 1.2  # what iterations take longer for inter-reflection: 1 without, 1.4 where much mirrors itself


def iterations_time(growth: float, progress: float) -> float:
    """The seconds that a training's iterations have taken by this progress, 0..1, if all of them took one second at first, and `growth`
    at the end."""
    first, last = GROWS
    ramp = min(max(progress - first, 0.0), last - first)
    more = ramp**2 / (2 * (last - first)) + max(progress - last, 0.0)
    return progress + (growth - 1) * more


def growth(first: int, last: int) -> float:
    """How many times as long an iteration is expected to take at the end, with so many surfels in place of those at first."""
    return MIRRORED * (OTHERS + max(last, first)) / (OTHERS + first)


class Plan:
    """A time by which a training is to have ended, its asset written. What it waited for while it was paused is not counted."""

    def __init__(self, minutes: float | None):
        """It begins now; without `minutes` there is no such time."""
        self.minutes, self._begun = minutes, time.perf_counter()
        self.before = 0.0  # seconds that were spent before the training was gone on with
        self._growth, self._marks = 1.0, [(0, 0.0)]

    @property
    def spent(self) -> float:
        """Seconds since the command was given, and those before."""
        return self.before + time.perf_counter() - self._begun

    def wait(self, seconds: float) -> None:
        """Leave out what was waited."""
        self._begun += seconds

    def begin(self, iteration: int, growth: float) -> None:
        """Iterations begin here, which at the end are expected to take `growth` times as long as the first."""
        self._growth, self._marks = growth, [(iteration, self.spent)]

    def total(self, iteration: int, views: int) -> int | None:
        """How many iterations there are to be with so many photos, at the pace until now; None where it is not time to ask."""
        done = iteration - self._marks[0][0]
        if self.minutes is None or not (done == FIRST or (done > 0 and iteration % EVERY == 0)):
            return None
        # The later half of what is done says most about what is left, and holds its share of what is done now and then.
        half, then = next(mark for mark in reversed(self._marks) if mark[0] <= iteration - done / 2)
        now = self.spent
        self._marks.append((iteration, now))
        pace, left = (now - then) / (iteration - half), 60 * self.minutes - now

        def ahead(total: int) -> float:
            """Seconds that all but these iterations of so many take, and what comes after them."""
            whole, by_now, by_half = (
                iterations_time(self._growth, k / total) * total for k in (total, iteration, half)
            )
            at_first = pace * (iteration - half) / (by_now - by_half)  # seconds that the first iterations took
            return at_first * (whole - by_now + self._growth * (END_A_VIEW * views + END))

        low, high = iteration, 2 * iteration + int(2 * max(left, 0.0) / pace)
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if ahead(middle) <= left else (low, middle)
        return low
