"""Measure the peak speed of this machine: arithmetic operations and memory traffic per second."""

import time

import torch

from refgs.kernels.layout import struct
from refgs.kernels.load import kernels, run

CPU = torch.device("cpu")
CHAINS = 12  # independent chains of operations in peak.cpp


_Peak = struct("Peak", "peak.cpp")


def arithmetic(seconds: float = 0.5, device: torch.device = CPU) -> float:
    """Measure how many floating-point operations per second this machine can do. Return the best of many runs.

    The CPU is measured with as many threads as torch uses. A multiply-add counts as two operations.
    """
    on_card = device.type == "cuda"
    launches = 20 if on_card else 1  # several launches, so that waiting for the card adds little
    rounds, one = (1 << 20, 2 * 1000 * CHAINS) if on_card else (1000, kernels().refgs_peak_round())
    work, out = _Peak(rounds=rounds), torch.zeros(1, device=device)
    work.attach(out=out)
    best, started = 0.0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        at = time.perf_counter()
        for _ in range(launches):
            run("refgs_peak", work, out, items=rounds)
        if on_card:
            torch.cuda.synchronize(device)
        best = max(best, launches * rounds * one / (time.perf_counter() - at))
    return best


def bandwidth(seconds: float = 0.5, device: torch.device = CPU) -> float:
    """Measure how many bytes per second this machine can read and write, by copying more memory than fits into the caches.

    The CPU is measured with as many threads as torch uses.
    """
    source = torch.ones(64 << 20, device=device)
    target, best, started = source.clone(), 0.0, time.perf_counter()
    copies = 20 if device.type == "cuda" else 1
    while time.perf_counter() - started < seconds:
        at = time.perf_counter()
        for _ in range(copies):
            target.copy_(source)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        best = max(best, copies * 2 * source.nbytes / (time.perf_counter() - at))
    return best
