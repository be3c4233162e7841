"""What more threads bring: `refgs bench threads`. The rasteriser and a whole iteration beside a loop of nothing but arithmetic,
which is what this machine's cores have to give; and twice as many threads as there are cores, which should cost nothing."""

import refgs  # noqa: F401, I001  first: it sets how OpenMP's idle threads wait, which torch reads when it loads

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
from benchmarks.iteration import make_trainer
from benchmarks.kernels import CHANNELS, SIDE, ball
from benchmarks.machine import arithmetic
from rich.console import Console
from rich.progress import track
from rich.table import Table

from refgs import CORES
from refgs.paths import clone_root
from refgs.render.rasterize import rasterize

ROUNDS, REPEATS = 3, 40


def _least(step: Callable[[], object]) -> float:
    """Seconds of the quickest of some repeats."""
    times = []
    for _ in range(REPEATS):
        at = time.perf_counter()
        step()
        times.append(time.perf_counter() - at)
    return min(times)


def measure() -> dict[str, float]:
    """Seconds of each part with this process's threads."""
    surfels, camera = ball()
    inputs = [v.requires_grad_() for v in surfels]
    upstream = [torch.rand(SIDE, SIDE, CHANNELS), torch.rand(SIDE, SIDE), torch.rand(SIDE, SIDE)]
    with tempfile.TemporaryDirectory() as folder:
        trainer = make_trainer(Path(folder))
        return {
            "arithmetic": 1 / arithmetic(0.5),
            "raster both ways": _least(
                lambda: torch.autograd.grad(rasterize(*inputs, camera, near=0.1), inputs, upstream)
            ),
            "a whole iteration": _least(trainer.step),
        }


def main() -> None:
    """Print a row a number of threads; each is measured in several processes, by turns, and the least is taken."""
    counts = sorted({1, *(2**k for k in range(8) if 2**k < CORES), CORES, 2 * CORES})
    best: dict[tuple[str, int], float] = {}
    for _ in track(range(ROUNDS), "measuring"):
        for threads in counts:
            command = [sys.executable, "-m", "benchmarks.threads", "--measure"]
            environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
            done = subprocess.run(
                command, stdout=subprocess.PIPE, text=True, check=True, cwd=clone_root(), env=environment
            )
            for part, seconds in json.loads(done.stdout).items():
                best[part, threads] = min(best.get((part, threads), seconds), seconds)
    parts = list(dict.fromkeys(part for part, _ in best))
    table = Table(
        "threads", *parts, title=f"{CORES} cores: times as fast as one thread (ms; share of arithmetic's gain)"
    )
    for threads in counts:
        gains = {part: best[part, 1] / best[part, threads] for part in parts}
        cells = [f"{gains['arithmetic']:.2f}"]
        for part in parts[1:]:
            share = gains[part] / gains["arithmetic"]
            cells.append(f"{gains[part]:.2f} ({1e3 * best[part, threads]:.1f} ms; {share:.0%})")
        table.add_row(str(threads), *cells)
    Console().print(table)


if __name__ == "__main__":
    if sys.argv[1:] == ["--measure"]:
        print(json.dumps(measure()))
    else:
        main()
