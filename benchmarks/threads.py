"""What more threads bring: `refgs bench threads`. The rasteriser and a whole iteration beside a loop of nothing but arithmetic,
which is what this machine's cores have to give; and twice as many threads as there are cores, which should cost nothing."""

import refgs  # noqa: F401, I001  first: it sets how OpenMP's idle threads wait, which torch reads when it loads

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
from benchmarks.iteration import make_trainer
from benchmarks.kernels import CHANNELS, SIDE, ball
from benchmarks.machine import arithmetic
from rich.console import Console
from rich.table import Table

from refgs.kernels.load import cores
from refgs.render.rasterize import rasterize

ROUNDS, REPEATS = 4, 15


def _least(step: Callable[[], None]) -> float:
    """Seconds of the quickest of some repeats."""
    times = []
    for _ in range(REPEATS):
        at = time.perf_counter()
        step()
        times.append(time.perf_counter() - at)
    return min(times)


def main() -> None:
    """Print a row a number of threads; each is measured several times, by turns, and the least is taken."""
    surfels, camera = ball()
    inputs = [v.requires_grad_() for v in surfels]
    upstream = [torch.rand(SIDE, SIDE, CHANNELS), torch.rand(SIDE, SIDE), torch.rand(SIDE, SIDE)]
    counts = sorted({1, *(2**k for k in range(8) if 2**k < cores()), cores(), 2 * cores()})

    def raster() -> None:
        torch.autograd.grad(rasterize(*inputs, camera, near=0.1), inputs, upstream)

    before, best = torch.get_num_threads(), {}
    with tempfile.TemporaryDirectory() as folder:
        trainer = make_trainer(Path(folder))
        parts = {
            "arithmetic": lambda: 1 / arithmetic(0.3),
            "raster both ways": lambda: _least(raster),
            "a whole iteration": lambda: _least(trainer.step),
        }
        for _ in range(ROUNDS):
            for threads in counts:
                torch.set_num_threads(threads)
                for part, measure in parts.items():
                    best[part, threads] = min(best.get((part, threads), 1e9), measure())
    torch.set_num_threads(before)
    table = Table(
        "threads", *parts, title=f"{cores()} cores: times as fast as one thread (ms; share of arithmetic's gain)"
    )
    for threads in counts:
        gains = {part: best[part, 1] / best[part, threads] for part in parts}
        cells = [f"{gains['arithmetic']:.2f}"]
        for part in list(parts)[1:]:
            share = gains[part] / gains["arithmetic"]
            cells.append(f"{gains[part]:.2f} ({1e3 * best[part, threads]:.1f} ms; {share:.0%})")
        table.add_row(str(threads), *cells)
    Console().print(table)


if __name__ == "__main__":
    main()
