"""Time and memory of the rasteriser against its size: `refgs bench scaling`.

The ball of `benchmarks.kernels` with 10³ … 10⁶ surfels, drawn 128² … 1024² pixels large, 11 channels as in training. Each size runs
in a process of its own. Memory is set against what the tensors need: the surfels and the maps' derivatives, which are given; the
maps and the surfels' derivatives, which are returned; the splats' projections and places, which backward reads again, and its
row of derivatives for each pair of splat and tile.
"""

import refgs  # noqa: F401, I001  first: it sets how OpenMP's idle threads wait, which torch reads when it loads

import json
import math
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch
from benchmarks.kernels import ball
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.optimize import nnls

from refgs.camera import Camera
from refgs.kernels.load import kernels
from refgs.render.rasterize import rasterize

SPLATS, SIDES, CHANNELS = (1_000, 10_000, 100_000, 1_000_000), (128, 256, 512, 1024), 11
ROOT = Path(__file__).parents[1]
SECONDS = 1.5  # that a size is repeated for


def _megabytes(name: str) -> float:
    """VmRSS, what this process holds now, or VmHWM, the most since the last reset; Linux."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name))
    return int(line.split()[1]) / 1024


def measure(splats: int, side: int) -> dict[str, float]:
    """Least milliseconds forward and backward, pairs of splat and tile, and megabytes: in use at most, what is given with it,
    and what the tensors need."""

    def run(inputs: list[torch.Tensor], camera: Camera, upstream: list[torch.Tensor]) -> tuple[float, float, int, int]:
        at = time.perf_counter()
        raster = rasterize(*inputs, camera, near=0.1)
        middle = time.perf_counter()
        torch.autograd.grad(raster, inputs, upstream)
        ended, work = time.perf_counter(), raster.features.grad_fn.work
        rows = 4 * work.row_count * kernels().refgs_row_size(CHANNELS)
        return middle - at, ended - middle, work.pairs, rows + sum(v.nbytes for v in work.kept.values())

    def scene(splats: int, side: int) -> tuple:
        surfels, camera = ball(splats, side, CHANNELS)
        upstream = [torch.rand(side, side, CHANNELS), torch.rand(side, side), torch.rand(side, side)]
        return [v.requires_grad_() for v in surfels], camera, upstream

    run(*scene(10, 16))
    inputs, camera, upstream = scene(splats, side)
    Path("/proc/self/clear_refs").write_text("5")  # resets VmHWM
    before, started, times = _megabytes("VmRSS"), time.perf_counter(), []
    while time.perf_counter() - started < SECONDS or len(times) < 4:
        times.append(run(inputs, camera, upstream))
    forward, backward, pairs, kept = np.array(times[1:]).min(axis=0).tolist()
    given = sum(v.nbytes for v in (*inputs, *upstream))  # as much is returned: a derivative of each, a map for each
    return {
        "splats": splats,
        "pixels": side * side,
        "pairs": int(pairs),
        "forward": 1e3 * forward,
        "backward": 1e3 * backward,
        "megabytes": _megabytes("VmHWM") - before + given / 2**20,
        "needed": (2 * given + kept) / 2**20,
    }


def main() -> None:
    """Print a row a size; then the law: time as a sum of parts proportional to splats, pixels and pairs, and its error."""
    sizes = [(n, side) for n in SPLATS for side in SIDES]
    command = [sys.executable, "-m", "benchmarks.scaling", "--size"]
    rows = []
    for size in track(sizes, "measuring"):
        done = subprocess.run([*command, *map(str, size)], stdout=subprocess.PIPE, text=True, check=True, cwd=ROOT)
        rows.append(json.loads(done.stdout))
    columns = ("splats", "pixels", "pairs", "forward", "backward", "megabytes", "needed")
    table = Table(*columns, title="milliseconds, the least; megabytes in use, and needed")
    for row in rows:
        table.add_row(*(f"{row[c]:,.1f}" if isinstance(row[c], float) else f"{row[c]:,}" for c in columns))
    console = Console()
    console.print(table)
    causes = ("splats", "pixels", "pairs")
    for effect in ("forward", "backward", "megabytes"):
        measured = np.array([row[effect] for row in rows])
        terms = np.array([[1.0, *(row[c] for c in causes)] for row in rows])
        # Relative errors count alike, so that the law holds for small sizes too.
        law, _ = nnls(terms / measured[:, None], np.ones(len(rows)))
        wrong = np.abs(terms @ law / measured - 1)
        parts = " + ".join(f"{1e6 * k:.3g} a million {c}" for k, c in zip(law[1:], causes, strict=True) if k > 0)
        console.print(f"{effect}: {law[0]:.3g} + {parts}; off by {wrong.mean():.0%}, {wrong.max():.0%} at most")
        for side in SIDES:
            few, many = (next(r for r in rows if (r["splats"], r["pixels"]) == (n, side * side)) for n in SPLATS[-2:])
            power = math.log(many[effect] / few[effect]) / math.log(SPLATS[-1] / SPLATS[-2])
            console.print(
                f"  at {side}², from {SPLATS[-2]:,} to {SPLATS[-1]:,} splats: as their number to the {power:.2f}"
            )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--size"]:
        print(json.dumps(measure(int(sys.argv[2]), int(sys.argv[3]))))
    else:
        main()
