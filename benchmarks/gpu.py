"""All that a CUDA card is measured by, in one go: `refgs bench gpu`.

Prints, for the ball of `benchmarks.kernels` at three sizes, the rasteriser forward and backward beside its floor by bytes and by
operations, and beside gsplat's 2DGS where gsplat is installed; frames a second of the whole renderer; the kernels of an
iteration; then trains a scene of 100 views with ground truth by the presets `standard` and `paper`. Every time ends with the
card's work being done.
"""

import refgs  # noqa: F401, I001  first: it sets how OpenMP's idle threads wait, which torch reads when it loads

import json
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from benchmarks.floors import Machine, raster
from benchmarks.kernels import ball
from rich.console import Console
from rich.table import Table

from refgs.camera import Camera
from refgs.kernels import cuda
from refgs.kernels.load import cache_folder
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.paths import clone_root
from refgs.render.rasterize import rasterize
from refgs.render.renderer import render
from refgs.settings import load_settings

SIZES = ((20_000, 400, 400), (200_000, 800, 800), (1_000_000, 1600, 1060))  # surfels, width, height
CHANNELS, WARM, ROUNDS = 16, 3, 20
FRAMES = (200_000, 800)
SCENE = ("jar", 800, 100)  # of benchmarks.scenes; pixels; training views
console = Console()


def synchronise(device: torch.device) -> None:
    """Wait until the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def milliseconds(step: Callable[[], object], device: torch.device, rounds: int = ROUNDS) -> list[float]:
    """Of each round, after some to get warm."""
    times = []
    for i in range(WARM + rounds):
        synchronise(device)
        at = time.perf_counter()
        step()
        synchronise(device)
        if i >= WARM:
            times.append(1e3 * (time.perf_counter() - at))
    return times


def least(times: Sequence[float]) -> str:
    """The least and, in brackets, the median."""
    return f"{min(times):.2f} ({statistics.median(times):.2f})"


def make_ball(splats: int, width: int, height: int, device: torch.device) -> tuple[list[torch.Tensor], Camera]:
    """The ball of `benchmarks.kernels` in a picture of any shape."""
    surfels, camera = ball(splats, min(width, height), CHANNELS)
    camera = Camera(camera.name, width, height, camera.fx, camera.fy, width / 2, height / 2, camera.world_to_camera)
    return [v.to(device) for v in surfels], camera


def gsplat_step(
    surfels: list[torch.Tensor], camera: Camera, upstream: list[torch.Tensor]
) -> Callable[[], object] | None:
    """The same picture forward and backward by gsplat's `rasterization_2dgs`; None where gsplat is not installed."""
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


def raster_table(device: torch.device, sizes: Sequence[tuple[int, int, int]] = SIZES, rounds: int = ROUNDS) -> None:
    """Print the rasteriser at each size, its floors, and gsplat."""
    machine = Machine.measured(device)
    measured = f"{machine.operations / 1e12:.1f} TFLOP/s, {machine.bytes / 1e9:.0f} GB/s measured"
    title = f"rasteriser, {CHANNELS} channels: ms, least (median); {measured}"
    table = Table(
        "surfels",
        "picture",
        "forward",
        "backward",
        "both",
        "floor: bytes",
        "operations",
        "gsplat",
        "times as fast",
        title=title,
    )
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

        rows = [milliseconds(step, device, rounds) for step in (forward, backward, both)]
        peer = gsplat_step(inputs, camera, upstream)
        theirs = milliseconds(peer, device, rounds) if peer else None
        needs = raster(inputs, camera)
        by_bytes = 1e3 * sum(need.bytes for need in needs) / machine.bytes
        by_operations = 1e3 * sum(need.operations for need in needs) / machine.operations
        table.add_row(
            f"{splats:,}",
            f"{width}×{height}",
            *map(least, rows),
            f"{by_bytes:.2f}",
            f"{by_operations:.2f}",
            least(theirs) if theirs else "not installed",
            f"{statistics.median(theirs) / statistics.median(rows[2]):.2f}" if theirs else "",
        )
    console.print(table)


def frame_table(device: torch.device, splats: int = FRAMES[0], side: int = FRAMES[1], rounds: int = 100) -> None:
    """Print frames a second of the whole renderer, deferred shading and all."""
    (positions, rotations, scales, opacities, _), camera = make_ball(splats, side, side, device)
    one = torch.ones(splats, device=device)
    none = [torch.zeros(splats, count, 3, device=device) for count in (1, 0)]
    materials = 0.7 * one[:, None].expand(-1, 3), one, 0.3 * one, one[:, None].expand(-1, 3)
    surfels = Surfels(positions, rotations, scales, opacities, *none, *materials, *none)
    background, settings = torch.ones(3, device=device), load_settings("standard").render
    with torch.no_grad():
        light = Environment(torch.rand(6 * 128**2, 3, device=device))
        times = milliseconds(lambda: render(surfels, light, camera, background, settings, 0.1), device, rounds)
    console.print(
        f"whole renderer, {splats:,} surfels, {side}×{side}: {least(times)} ms a frame, "
        f"{1e3 / statistics.median(times):.0f} frames a second, each waited for"
    )


def iteration_table(device: torch.device, rounds: int = ROUNDS) -> None:
    """Print a whole iteration of the deferred stage, and where the card's time goes by kernel."""
    from tempfile import TemporaryDirectory

    from benchmarks.iteration import make_trainer

    with TemporaryDirectory() as folder:
        trainer = make_trainer(Path(folder), device.type)
        times = milliseconds(trainer.step, device, rounds)
        console.print(f"a whole iteration, 256×256, 20,000 surfels: {least(times)} ms")
        if device.type != "cuda":
            return
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
            for _ in range(rounds):
                trainer.step()
            synchronise(device)
    table = Table("kernel", "calls an iteration", "ms an iteration", title="the card's time")
    events = sorted(profile.key_averages(), key=lambda event: -event.self_device_time_total)
    for event in events[:30]:
        table.add_row(
            event.key[:60], f"{event.count / rounds:.1f}", f"{event.self_device_time_total / 1e3 / rounds:.3f}"
        )
    console.print(table)


def training_table(device: torch.device, folder: Path) -> None:
    """Train the scene by both presets; print seconds and held-out figures. The capture is made where there is none."""
    name, side, views = SCENE
    capture = folder / f"{name}-{side}"
    if not capture.exists():
        command = [sys.executable, "-m", "benchmarks.scenes", name, "--out", capture, "--size", side, "--train", views]
        subprocess.run(
            [*map(str, command), "--test", "20", "--samples", "64"],
            check=True,
            cwd=clone_root(),
            stdout=subprocess.DEVNULL,
        )
    table = Table(
        "preset", "seconds", "PSNR", "SSIM", title=f"{name}, {views} views of {side}×{side}, trained on {device.type}"
    )
    for preset in ("standard", "paper"):
        if not (clone_root() / "presets" / f"{preset}.toml").exists():
            table.add_row(preset, "there is no such preset", "", "")
            continue
        run, cli = folder / f"{name}-{preset}-{time.strftime('%H%M%S')}", [sys.executable, "-m", "refgs.cli"]
        at = time.perf_counter()
        command = [*cli, "train", str(capture), "--out", str(run), "--preset", preset, "--device", device.type]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        seconds = time.perf_counter() - at
        subprocess.run([*cli, "evaluate", str(run)], check=True, stdout=subprocess.DEVNULL)
        found = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
        table.add_row(preset, f"{seconds:.0f}", f"{found['psnr']:.2f}", f"{found['ssim']:.4f}")
    console.print(table)


def main() -> None:
    """Run it all."""
    if why := cuda.unusable():
        console.print(f"no figures of a card from here: {why}")
        raise SystemExit(2)
    device = torch.device("cuda")
    at = time.perf_counter()
    major, minor = torch.cuda.get_device_capability()
    for source in cuda.SOURCES:
        cuda.cubin(source, f"sm_{major}{minor}", cache_folder())
    name, memory = torch.cuda.get_device_name(), torch.cuda.get_device_properties(device).total_memory / 2**30
    console.print(
        f"{name}, {memory:.0f} GB, sm_{major}{minor}; torch {torch.__version__}, Python {platform.python_version()}"
    )
    console.print(f"kernels compiled in {time.perf_counter() - at:.1f} s (next to nothing where they were before)")
    raster_table(device)
    frame_table(device)
    iteration_table(device)
    training_table(device, clone_root() / "demo")


if __name__ == "__main__":
    main()
