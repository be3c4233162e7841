"""Measure the speed of RefGS on an NVIDIA GPU: `refgs bench gpu`.

Four things are measured:
- the rasteriser, forward and backward, at three sizes. Its times are compared with its floors (the least possible times), and with gsplat's
  2DGS if gsplat is installed;
- rendering a whole frame;
- one training iteration, and each kernel in it;
- training a scene of 100 photos with the presets `standard` and `paper`: time and quality.
"""

import argparse
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from benchmarks.floors import Machine, raster
from benchmarks.harness import Bench, Column, Table, console, figures, train
from benchmarks.iteration import make_trainer
from benchmarks.kernels import ball
from refgs.camera import Camera
from refgs.kernels import cuda
from refgs.kernels.load import cache_folder
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.paths import clone_environment, clone_root
from refgs.render.rasterize import rasterize
from refgs.render.renderer import render
from refgs.settings import load_settings

SIZES = ((20_000, 400, 400), (200_000, 800, 800), (1_000_000, 1600, 1060))  # surfels, width, height
CHANNELS, WARM, ROUNDS = 16, 3, 20
FRAMES = (200_000, 800)
SCENE = ("jar", 800, 100)  # of benchmarks.scenes; pixels; training views
RASTER, WHOLE, KERNEL, TRAINING = "rasteriser", "whole", "kernel", "training"
TABLES = (
    Table(
        f"rasteriser, {CHANNELS} channels: ms",
        "gpu",
        (
            Column("forward", "forward", ".2f", RASTER),
            Column("backward", "backward", ".2f", RASTER),
            Column("both", "both", ".2f", RASTER),
            Column("floor: bytes", "by_bytes", ".2f", RASTER),
            Column("operations", "by_operations", ".2f", RASTER),
            Column("gsplat", "gsplat", ".2f", RASTER),
        ),
    ),
    Table("the whole", "gpu", (Column("ms, least", "least", ".2f", WHOLE), Column("median", "median", ".2f", WHOLE))),
    Table(
        "an iteration by kernel",
        "gpu",
        (Column("calls", "calls", ".1f", KERNEL), Column("ms", "milliseconds", ".3f", KERNEL)),
    ),
    Table(
        f"{SCENE[0]}, {SCENE[2]} views of {SCENE[1]}×{SCENE[1]}",
        "gpu",
        (
            Column("seconds", "seconds", ".0f", TRAINING),
            Column("PSNR dB", "psnr", ".2f", TRAINING),
            Column("SSIM", "ssim", ".4f", TRAINING),
        ),
        line="preset",
    ),
)


def synchronise(device: torch.device) -> None:
    """Wait until the device has finished all work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def milliseconds(step: Callable[[], object], device: torch.device, rounds: int = ROUNDS) -> list[float]:
    """Call `step` repeatedly; return the milliseconds of each of `rounds` calls. WARM earlier calls are not timed."""
    times = []
    for i in range(WARM + rounds):
        synchronise(device)
        at = time.perf_counter()
        step()
        synchronise(device)
        if i >= WARM:
            times.append(1e3 * (time.perf_counter() - at))
    return times


def make_ball(splats: int, width: int, height: int, device: torch.device) -> tuple[list[torch.Tensor], Camera]:
    """Make surfels on a unit ball (see `benchmarks.kernels.ball`), and a camera that looks at it.

    The camera's image has `width` × `height` pixels. The surfels' tensors are on `device`.
    """
    surfels, camera = ball(splats, min(width, height), CHANNELS)
    camera = Camera(camera.name, width, height, camera.fx, camera.fy, width / 2, height / 2, camera.world_to_camera)
    return [v.to(device) for v in surfels], camera


def gsplat_step(
    surfels: list[torch.Tensor], camera: Camera, upstream: list[torch.Tensor]
) -> Callable[[], object] | None:
    """Return a function that renders the surfels with gsplat's `rasterization_2dgs`, and computes their gradients.

    `upstream` are the gradients of the rendered images. Return None if gsplat is not installed.
    """
    try:
        from gsplat import rasterization_2dgs
    except ImportError:
        return None
    positions, rotations, scales, opacities, features = surfels
    device = positions.device
    view = torch.from_numpy(camera.world_to_camera).float()[None].to(device)
    lens = torch.tensor([[[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]], device=device)
    thick = torch.cat([scales, torch.ones_like(scales[:, :1])], dim=1)

    def step() -> None:
        color, alpha, *_ = rasterization_2dgs(
            positions, rotations, thick, opacities, features, view, lens, camera.width, camera.height, near_plane=0.1
        )
        torch.autograd.grad([color[0], alpha[0, ..., 0]], surfels, [upstream[0], upstream[2]])

    return step


def measure_raster(
    bench: Bench, device: torch.device, sizes: Sequence[tuple[int, int, int]] = SIZES, rounds: int = ROUNDS
) -> None:
    """Time the rasteriser, and gsplat if it is installed, for each of `sizes`: number of surfels, width and height of the image.

    Add the median times, and the rasteriser's floors (the least possible times), to the rows of `bench`.
    """
    machine = Machine.measured(device)
    for splats, width, height in sizes:
        surfels, camera = make_ball(splats, width, height, device)
        inputs = [v.requires_grad_() for v in surfels]
        shapes = [(height, width, CHANNELS), (height, width), (height, width)]
        upstream, state = [torch.rand(s, device=device) for s in shapes], {}

        def forward(inputs: list = inputs, camera: Camera = camera, state: dict = state) -> None:
            state["raster"] = rasterize(*inputs, camera, near=0.1)

        def backward(inputs: list = inputs, upstream: list = upstream, state: dict = state) -> None:
            torch.autograd.grad(state["raster"], inputs, upstream, retain_graph=True)

        def both(forward: Callable = forward, backward: Callable = backward) -> None:
            forward()
            backward()

        steps = {"forward": forward, "backward": backward, "both": both}
        if peer := gsplat_step(inputs, camera, upstream):
            steps["gsplat"] = peer
        times = {name: statistics.median(milliseconds(step, device, rounds)) for name, step in steps.items()}
        costs = raster(inputs, camera)
        by_bytes = 1e3 * sum(cost.bytes for cost in costs) / machine.bytes
        by_operations = 1e3 * sum(cost.operations for cost in costs) / machine.operations
        size = f"{splats:,} surfels, {width}×{height}"
        bench.record(size, RASTER, "ms", **times, by_bytes=by_bytes, by_operations=by_operations)


def measure_frames(
    bench: Bench, device: torch.device, splats: int = FRAMES[0], side: int = FRAMES[1], rounds: int = 100
) -> None:
    """Time the rendering of a whole frame with deferred shading. Add the least and the median time to the rows of `bench`."""
    (positions, rotations, scales, opacities, _), camera = make_ball(splats, side, side, device)
    one = torch.ones(splats, device=device)
    none = [torch.zeros(splats, count, 3, device=device) for count in (1, 0)]
    materials = 0.7 * one[:, None].expand(-1, 3), one, 0.3 * one, one[:, None].expand(-1, 3)
    surfels = Surfels(positions, rotations, scales, opacities, *none, *materials, *none)
    background, settings = torch.ones(3, device=device), load_settings("standard").render
    with torch.no_grad():
        light = Environment(torch.rand(6 * 128**2, 3, device=device))
        times = milliseconds(lambda: render(surfels, light, camera, background, settings, 0.1), device, rounds)
    name = f"a frame, {splats:,} surfels, {side}×{side}"
    bench.record(name, WHOLE, "ms", least=min(times), median=statistics.median(times))


def measure_iteration(bench: Bench, device: torch.device, rounds: int = ROUNDS) -> None:
    """Time a training iteration with deferred shading, and on a GPU each kernel in it. Add the times to the rows of `bench`."""
    with TemporaryDirectory() as folder:
        trainer = make_trainer(Path(folder), device.type)
        times = milliseconds(trainer.step, device, rounds)
        name = "an iteration, 20,000 surfels, 256×256"
        bench.record(name, WHOLE, "ms", least=min(times), median=statistics.median(times))
        if device.type != "cuda":
            return
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
            for _ in range(rounds):
                trainer.step()
            synchronise(device)
    events = sorted(profile.key_averages(), key=lambda event: -event.self_device_time_total)
    for event in events[:30]:
        spent = event.self_device_time_total / 1e3 / rounds
        bench.record(event.key[:60], KERNEL, "", calls=event.count / rounds, milliseconds=spent)


def measure_trainings(bench: Bench, device: torch.device, folder: Path) -> None:
    """Train a scene with the presets `standard` and `paper`. Add the times and the quality to the rows of `bench`.

    The scene's photos are rendered into `folder` first, if they are not there yet.
    """
    name, side, views = SCENE
    capture = folder / f"{name}-{side}"
    if not capture.exists():
        words = ("--size", side, "--train", views, "--test", 20, "--samples", 64)
        command = [sys.executable, "-m", "benchmarks.scenes", name, "--out", capture, *words]
        how = {"cwd": clone_root(), "env": clone_environment(), "stdout": subprocess.DEVNULL}
        subprocess.run([str(word) for word in command], check=True, **how)
    for preset in ("standard", "paper"):
        run = folder / f"{name}-{preset}-{time.strftime('%H%M%S')}"
        if not train(capture, run, ("--preset", preset, "--device", device.type)):
            bench.failed.append(run)
            continue
        found = figures(run)
        bench.record(preset, TRAINING, "s", seconds=found["total_seconds"])
        bench.record(preset, TRAINING, "dB", psnr=found["psnr"])
        bench.record(preset, TRAINING, "", ssim=found["ssim"])


def main(arguments: Sequence[str] | None = None) -> None:
    """Run all measurements; exit with status 2 if there is no usable GPU."""
    bench = Bench("gpu", argparse.ArgumentParser(description=__doc__.splitlines()[0]), arguments)
    if why := cuda.unusable():
        console.print(f"no figures of a card from here: {why}")
        raise SystemExit(2)
    device, at = torch.device("cuda"), time.perf_counter()
    major, minor = torch.cuda.get_device_capability()
    for source in cuda.SOURCES:
        cuda.cubin(source, f"sm_{major}{minor}", cache_folder())
    bench.where = f"{torch.cuda.get_device_name()}, sm_{major}{minor}", *bench.where[1:]
    console.print(f"{bench.where[0]}; kernels compiled in {time.perf_counter() - at:.1f} s, or read from the cache")
    measure_raster(bench, device)
    measure_frames(bench, device)
    measure_iteration(bench, device)
    measure_trainings(bench, device, clone_root() / "demo")
    bench.finish(*TABLES)
