"""Time the CPU kernels and a training iteration: `refgs bench kernels`.

The kernels' scene resembles the start of a training on a visual hull: a ball of 20,000 discs fills most of the picture. The discs lie at
random places and are tangent to the ball. Both scales of a disc are the mean distance to its three nearest neighbours; its opacity is
0.73. Half of the discs face away from the camera and are mostly hidden.
"""

import argparse
import os
import statistics
import time
from collections.abc import Callable, Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree

from benchmarks import floors, iteration
from benchmarks.harness import Bench, Column, Table
from refgs.camera import Camera
from refgs.kernels import load
from refgs.model.environment import Environment
from refgs.model.prefilter import prefilter
from refgs.render import raster_cpu
from refgs.render.rasterize import rasterize
from refgs.render.shade import shade
from refgs.render.ssim import dssim

SPLATS, SIDE, CHANNELS, ROUNDS, THREADS = 20_000, 400, 16, 30, 2
STEPS = {
    "binning": "projection, depth sort, tiles",
    "forward": "raster forward, with them",
    "backward": "raster backward",
    "both": "raster, both ways",
    "ssim": "D-SSIM, both ways",
    "shading": "deferred shading, both ways",
    "prefilter 64": "prefilter of 6×64², both ways",
    "prefilter 128": "prefilter of 6×128², both ways",
}
TABLES = (
    Table(
        f"{SPLATS:,} surfels, {SIDE}×{SIDE}, {CHANNELS} channels, {THREADS} threads: least ms",
        "kernels",
        (
            Column("AVX-512", "least", ".1f", "avx512"),
            Column("floor", "floor", ".1f", "avx512"),
            Column("AVX2", "least", ".1f", "avx2"),
            Column("floor", "floor", ".1f", "avx2"),
            Column("SSE4.2", "least", ".1f", "sse4"),
            Column("floor", "floor", ".1f", "sse4"),
            Column("NEON", "least", ".1f", "neon"),
            Column("floor", "floor", ".1f", "neon"),
        ),
        line="kernel",
    ),
    Table(
        f"an iteration, {iteration.SIZE}×{iteration.SIZE}, {iteration.SURFELS:,} surfels: ms",
        "kernels",
        (Column("least", "least", ".1f", "iteration"), Column("median", "median", ".1f", "iteration")),
        line="part",
    ),
)


def ball(splats: int = SPLATS, side: int = SIDE, channels: int = CHANNELS) -> tuple[list[torch.Tensor], Camera]:
    """Make the surfels (positions, rotations, scales, opacities, features) of a unit ball and a camera at distance 4."""
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(splats, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    spacing = cKDTree(normal).query(normal, k=4)[0][:, 1:].mean(axis=1)
    # Rotate z to the normal by the shortest way, then by a random angle about the normal.
    to_normal = np.concatenate([1 + normal[:, 2:], -normal[:, 1:2], normal[:, :1], np.zeros((splats, 1))], axis=1)
    surfels = [normal, to_normal, np.stack([spacing, spacing], axis=1), np.full(splats, 0.73)]
    surfels.append(rng.uniform(size=(splats, channels)))
    matrix = np.eye(4)
    matrix[2, 3] = 4
    focal = 0.48 * side * np.sqrt(4**2 - 1)  # the outline's radius becomes 0.48 of the image's side
    camera = Camera("ball", side, side, focal, focal, side / 2, side / 2, matrix)
    return [torch.tensor(v, dtype=torch.float32) for v in surfels], camera


def _time(*steps: Callable[[], None]) -> list[list[float]]:
    """Run all steps one after the other, ROUNDS times. Return for each step a list of its milliseconds."""
    rounds = []
    for _ in range(ROUNDS + 3):
        stamps = [time.perf_counter()]
        for step in steps:
            step()
            stamps.append(time.perf_counter())
        rounds.append(np.diff(stamps) * 1e3)
    return np.array(rounds[3:]).T.tolist()


def measure() -> dict[str, list[float]]:
    """Time each CPU kernel. Return for each a list of milliseconds. The environment variable REFGS_ISA names the instruction set."""
    surfels, camera = ball()
    detached = [v.clone() for v in surfels]
    inputs = [v.requires_grad_() for v in surfels]
    upstream = [torch.rand(SIDE, SIDE, CHANNELS), torch.rand(SIDE, SIDE), torch.rand(SIDE, SIDE)]
    target, image = torch.rand(SIDE, SIDE, 3), torch.rand(SIDE, SIDE, 3)
    state = {}

    def binning() -> None:
        work = raster_cpu.Raster(splats=SPLATS, channels=CHANNELS)
        work.attach(**dict(zip(("positions", "rotations", "scales", "opacities", "features"), detached, strict=True)))
        work.look(camera, 0.1)
        work.project(detached[0].device)

    def forward() -> None:
        state["raster"] = rasterize(*inputs, camera, near=0.1)

    def backward() -> None:
        torch.autograd.grad(state["raster"], inputs, upstream)

    times = dict(zip(("forward", "backward"), _time(forward, backward), strict=True))
    times["both"] = [a + b for a, b in zip(times["forward"], times["backward"], strict=True)]
    times |= {
        "binning": _time(binning)[0],
        "ssim": _time(lambda: dssim(image, target))[0],
        "shading": _time(_shading())[0],
    }
    return times | {f"prefilter {side}": _time(_prefilter(side))[0] for side in (64, 128)}


def _shading() -> Callable[[], None]:
    """Return a function that shades the ball as a rough metal under a random light, forward and backward."""
    (positions, *geometry, _), camera = ball()
    material = torch.tensor([0.9, 0.7, 0.5, 1.0, 0.3]).expand(SPLATS, 5)
    raster = rasterize(positions, *geometry, torch.cat([positions, material, positions], dim=1), camera, near=0.1)
    light = Environment(torch.rand(6 * 64**2, 3))
    leaves = [v.requires_grad_() for v in (raster.features, raster.alpha, light.levels)]
    upstream = [torch.rand(SIDE, SIDE, n) for n in (3, 3, 5)]

    def step() -> None:
        shaded = shade(raster.features, raster.alpha, light, camera, torch.ones(3))
        torch.autograd.grad((shaded.color, shaded.normal, shaded.material), leaves, upstream)

    return step


def _prefilter(side: int) -> Callable[[], None]:
    """Return a function that prefilters a cubemap of 6·side² texels, forward and backward."""
    radiance = torch.rand(6 * side**2, 3, requires_grad=True)
    upstream = torch.rand_like(prefilter(radiance, side))
    return lambda: torch.autograd.grad(prefilter(radiance, side), radiance, upstream)


def _costs() -> dict[str, floors.Cost]:
    """Compute how many operations the kernels do, and how many bytes they move. Return a dict from names of kernels to Costs."""
    surfels, camera = ball()
    forward, backward = floors.raster(surfels, camera)
    covered = int((rasterize(*surfels, camera, near=0.1).alpha > 1 / 255).sum())
    costs = {"forward": forward, "backward": backward, "ssim": floors.ssim(SIDE * SIDE)}
    costs["both"] = floors.Cost(*(a + b for a, b in zip(forward, backward, strict=True)))
    costs["shading"] = floors.shading(covered, SIDE * SIDE)
    return costs | {f"prefilter {side}": floors.prefiltering(side) for side in (64, 128)}


def measure_all(bench: Bench, threads: int = THREADS) -> None:
    """Time each kernel with each instruction set of this CPU. Add the times, and the least possible times, to the rows of `bench`."""
    before, chosen = torch.get_num_threads(), os.environ.get("REFGS_ISA")
    torch.set_num_threads(threads)
    try:
        for isa in load.supported():
            os.environ["REFGS_ISA"] = isa
            times, machine, costs = measure(), floors.Machine.measured(), _costs()
            for step, name in STEPS.items():
                floor = machine.floor(costs[step]) if step in costs else None
                least, median = min(times[step]), statistics.median(times[step])
                bench.record(name, isa, "ms", least=least, median=median, floor=floor)
    finally:
        torch.set_num_threads(before)
        os.environ.pop("REFGS_ISA")
        if chosen:
            os.environ["REFGS_ISA"] = chosen


def main(arguments: Sequence[str] | None = None) -> None:
    """Time the kernels and a training iteration, and print the tables."""
    bench = Bench("kernels", argparse.ArgumentParser(description=__doc__.splitlines()[0]), arguments)
    measure_all(bench)
    for part, seconds in iteration.measure().items():
        least, median = 1e3 * min(seconds), 1e3 * statistics.median(seconds)
        bench.record(part, "iteration", "ms", least=least, median=median)
    bench.finish(*TABLES)
