"""Error against run time of each approximation inside: `refgs bench approximations [--only WORD] [--out DIR]`.

Each module here has curves: functions that yield a `Row` a setting. The truth that they err from is none of this program's: an integral by
quadrature or by Monte Carlo, whose own standard error is told; an analytic shape; the float64 reference; many times the samples. Times are
the processor's, on one thread, the least of several runs: other work on the machine hardly changes them.
"""

import math
import time
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np

Result = TypeVar("Result")


class Row(NamedTuple):
    """What one setting of an approximation errs by and takes. `method` parts the lines of a chart. `uncertainty` is the truth's own
    standard error, in the error's unit; zero where it has none."""

    approximation: str
    method: str
    setting: float | str
    error: float
    unit: str
    milliseconds: float
    default: bool
    uncertainty: float = 0.0


def timed(step: Callable[..., Result], *given, seconds: float = 0.3) -> tuple[Result, float]:
    """What `step(*given)` returns, and the least of its milliseconds over so many seconds, at least one run; the processor's time."""
    least, spent = math.inf, 0.0
    while spent <= seconds and (seconds or not spent):
        begun = time.process_time()
        result = step(*given)
        took = time.process_time() - begun
        least, spent = min(least, took), spent + took
    return result, 1e3 * least


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


_rng = np.random.default_rng(5)
LAMPS = _rng.normal(size=(24, 3))
LAMPS /= np.linalg.norm(LAMPS, axis=1, keepdims=True)
SHARPNESS = np.exp(_rng.uniform(np.log(10), np.log(1500), 24))  # standard deviations of 18 to 1.5 degrees
_POWER = _rng.uniform(0.3, 1, 24) * np.sqrt(SHARPNESS) / 2


def room(direction: np.ndarray) -> np.ndarray:
    """Radiance (P,) along unit directions (P, 3): lamps large and small, the small ones brighter, before dim walls."""
    return 0.2 + np.exp(SHARPNESS * (direction @ LAMPS.T - 1)) @ _POWER
