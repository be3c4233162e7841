"""How long the CPU kernels take: `refgs bench kernels`, or `python -m benchmarks.kernels`.

The scene is a ball that fills most of the picture: 20,000 discs on its surface, at random (uniform), each tangent to it, both scales the
mean distance to its three nearest neighbours and opacity 0.73 — how training starts on a visual hull. Half of the discs face
away and are mostly hidden.
"""

import os
import platform
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

from benchmarks import floors
from refgs.camera import Camera
from refgs.kernels import load
from refgs.model.environment import Environment
from refgs.model.prefilter import prefilter
from refgs.render import raster_cpu
from refgs.render.rasterize import rasterize
from refgs.render.shade import shade
from refgs.render.ssim import dssim

SPLATS, SIDE, CHANNELS, ROUNDS = 20_000, 400, 16, 30


def ball(splats: int = SPLATS, side: int = SIDE, channels: int = CHANNELS) -> tuple[list[torch.Tensor], Camera]:
    """The surfels (positions, rotations, scales, opacities, features) and a camera at distance 4, the ball's radius being 1."""
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(splats, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    spacing = cKDTree(normal).query(normal, k=4)[0][:, 1:].mean(axis=1)
    # the shortest rotation from z to the normal, then any about it
    to_normal = np.concatenate([1 + normal[:, 2:], -normal[:, 1:2], normal[:, :1], np.zeros((splats, 1))], axis=1)
    surfels = [normal, to_normal, np.stack([spacing, spacing], axis=1), np.full(splats, 0.73)]
    surfels.append(rng.uniform(size=(splats, channels)))
    matrix = np.eye(4)
    matrix[2, 3] = 4
    focal = 0.48 * side * np.sqrt(4**2 - 1)  # the outline's radius is 0.48 of the picture's side
    camera = Camera("ball", side, side, focal, focal, side / 2, side / 2, matrix)
    return [torch.tensor(v, dtype=torch.float32) for v in surfels], camera


def _time(*steps: Callable[[], None]) -> list[list[float]]:
    """Milliseconds of each step, in each round."""
    rounds = []
    for _ in range(ROUNDS + 3):
        stamps = [time.perf_counter()]
        for step in steps:
            step()
            stamps.append(time.perf_counter())
        rounds.append(np.diff(stamps) * 1e3)
    return np.array(rounds[3:]).T.tolist()


def measure() -> dict[str, list[float]]:
    """Milliseconds of each step in each round, with the instruction set in REFGS_ISA and torch's threads."""
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
    """The ball as a rough metal under a light of noise, both ways."""
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
    """Of a cubemap of 6·side² texels, both ways."""
    radiance = torch.rand(6 * side**2, 3, requires_grad=True)
    upstream = torch.rand_like(prefilter(radiance, side))
    return lambda: torch.autograd.grad(prefilter(radiance, side), radiance, upstream)


def _needs() -> dict[str, floors.Need]:
    """What the steps have to do."""
    surfels, camera = ball()
    forward, backward = floors.raster(surfels, camera)
    covered = int((rasterize(*surfels, camera, near=0.1).alpha > 1 / 255).sum())
    needs = {"forward": forward, "backward": backward, "ssim": floors.ssim(SIDE * SIDE)}
    needs["both"] = floors.Need(*(a + b for a, b in zip(forward, backward, strict=True)))
    needs["shading"] = floors.shading(covered, SIDE * SIDE)
    return needs | {f"prefilter {side}": floors.prefiltering(side) for side in (64, 128)}


def run(threads: int = 2) -> dict[str, dict[str, list[float]]]:
    """Print a table, one column an instruction set; returns {set: {step: milliseconds of each round}}."""
    title = (
        f"{SPLATS:,} surfels, {SIDE}×{SIDE}, {CHANNELS} channels, {threads} threads: ms, least (median), floor, before²"
    )
    table, release, kept = Table("", title=title), "", {}
    steps = {"binning": "binning¹", "forward": "raster forward", "backward": "backward", "both": "both ways"}
    steps |= {"ssim": "D-SSIM, both ways", "shading": "deferred shading, both ways"}
    steps |= {f"prefilter {side}": f"prefilter of 6×{side}², both ways" for side in (64, 128)}
    results, floor, before, chosen = {}, {}, torch.get_num_threads(), os.environ.get("REFGS_ISA")
    torch.set_num_threads(threads)
    try:
        for isa in load.supported():
            os.environ["REFGS_ISA"] = isa
            results[isa], machine = measure(), floors.Machine.measured()
            floor[isa] = {step: machine.floor(need) for step, need in _needs().items()}
            release, kept[isa] = floors.previous("kernels", isa)
            table.add_column(isa, justify="right")
    finally:
        torch.set_num_threads(before)
        os.environ.pop("REFGS_ISA")
        if chosen:
            os.environ["REFGS_ISA"] = chosen
    for step, title in steps.items():
        cells = []
        for isa, times in results.items():
            least, middle = min(times[step]), statistics.median(times[step])
            beside = (f"{figures[step]:.1f}" if step in figures else "–" for figures in (floor[isa], kept[isa]))
            cells.append(", ".join([f"{least:.1f} ({middle:.1f})", *beside]))
        table.add_row(title, *cells)
    console = Console()
    console.print(table)
    console.print(f"¹ projection, depth sort and tiles; part of forward. {platform.processor() or platform.machine()}")
    console.print(
        f"² least of release {release}, on the machine of docs/benchmarks.toml" if release else "² nothing is kept"
    )
    return results


if __name__ == "__main__":
    run()
