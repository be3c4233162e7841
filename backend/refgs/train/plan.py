"""How many iterations fit into the time that a training was given, its start and its end included."""

import time

EVERY = 50  # iterations
FIRST = 10  # iterations, after which the pace is known well enough to say how many there are to be
# Iterations' time that writing the asset takes: for each photo, from all of which surfels are looked at, and besides.
END_A_VIEW, END = 0.5, 20


class Plan:
    """A time by which a training is to have ended, its asset written. What it waited for while it was paused is not counted."""

    def __init__(self, minutes: float | None):
        """It begins now; without `minutes` there is no such time."""
        self.minutes, self._begun = minutes, time.perf_counter()
        self.before = 0.0  # seconds that were spent before the training was gone on with
        self._mark: tuple[int, float] = (0, 0.0)

    @property
    def spent(self) -> float:
        """Seconds since the command was given, and those before."""
        return self.before + time.perf_counter() - self._begun

    def wait(self, seconds: float) -> None:
        """Leave out what was waited."""
        self._begun += seconds

    def begin(self, iteration: int) -> None:
        """Iterations begin here."""
        self._mark = iteration, self.spent

    def total(self, iteration: int, views: int) -> int | None:
        """How many iterations there are to be with so many photos, at the pace until now; None where it is not time to ask."""
        first, then = self._mark
        done = iteration - first
        if self.minutes is None or not (done == FIRST or (done > 0 and iteration % EVERY == 0)):
            return None
        pace = (self.spent - then) / done
        left = 60 * self.minutes - self.spent - pace * (END_A_VIEW * views + END)
        return iteration + max(0, int(left / pace))
