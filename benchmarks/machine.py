"""What this machine can do at the most, which other figures are set beside."""

import ctypes
import time

import torch

from refgs.kernels.load import Shared, Work, kernels, parallel


class _Peak(Work):
    """`struct Peak` of peak.cpp."""

    _fields_ = (("rounds", ctypes.c_int64), ("scratch", ctypes.c_void_p), ("shared", Shared))


def arithmetic(seconds: float = 0.5) -> float:
    """Floating-point operations a second, a product and a sum being two, on torch's threads; the best of many short runs."""
    library, rounds, best, started = kernels(), 1000, 0.0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        at = time.perf_counter()
        parallel(library.refgs_peak, _Peak(rounds=rounds), scratch=1)
        best = max(best, rounds * library.refgs_peak_round() / (time.perf_counter() - at))
    return best


def bandwidth(seconds: float = 0.5) -> float:
    """Bytes a second of memory, read and written, by copying more than the caches hold, on torch's threads; the best run."""
    source = torch.ones(64 << 20)
    target, best, started = torch.empty_like(source), 0.0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        at = time.perf_counter()
        target.copy_(source)
        best = max(best, 2 * source.nbytes / (time.perf_counter() - at))
    return best
