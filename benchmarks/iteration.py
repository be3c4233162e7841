"""A whole training iteration of the deferred stage, part by part and kernel by kernel: `refgs bench iteration`.

The scene is the repository's own, made without Blender: 256×256 photos of a metal ball that fills most of the frame,
20,000 surfels on its hull. Each part is timed by running the iteration's own functions up to it.
"""

import refgs  # noqa: F401, I001  first: it sets how OpenMP's idle threads wait, which torch reads when it loads

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
from benchmarks.floors import previous
from benchmarks.scenes.analytic import write_ball_capture
from rich.console import Console
from rich.table import Table

from refgs.capture import read_capture
from refgs.kernels import load
from refgs.render import raster_cpu
from refgs.render.renderer import render
from refgs.settings import load_settings
from refgs.train.light import mean_radiance
from refgs.train.losses import objective
from refgs.train.trainer import Trainer

SIZE, SURFELS, REPEATS = 256, 20_000, 30
ALONE = ("refgs_sort", "refgs_bin", "refgs_rows")  # kernels of one thread


def make_trainer(folder: Path, device: str = "cpu") -> Trainer:
    """In the middle of a training."""
    write_ball_capture(folder / "ball", SIZE, samples=2)
    changes = [f"surfels.start={SURFELS}", f"surfels.budget={SURFELS}", "train.light_first=0"]
    settings = load_settings("quick", changes)
    trainer = Trainer(read_capture(folder / "ball"), settings, folder, lambda *_: None, device=device)
    for _ in range(5):
        trainer.step()
    return trainer


def main() -> None:
    """Print milliseconds of the parts, least and median; then of the kernels, and what is left to Python and torch."""
    console, parts, kernels = Console(), {}, {}
    with tempfile.TemporaryDirectory() as folder:
        trainer = make_trainer(Path(folder))
        for _ in range(REPEATS):
            _one(trainer, parts)
        _watch(kernels)
        for _ in range(REPEATS):
            trainer.step()
    release, before = previous("iteration")
    count, threads = len(trainer.state.parameters["position"]), torch.get_num_threads()
    title = f"{SIZE}×{SIZE}, {count:,} surfels, {threads} threads: ms"
    table = Table("part", "least", "median", f"least of {release}", title=title)
    for name, seconds in parts.items():
        kept = f"{before[name]:.1f}" if name in before else ""
        table.add_row(name, f"{1e3 * min(seconds):.1f}", f"{1e3 * statistics.median(seconds):.1f}", kept)
    console.print(table)

    table = Table("kernel", "calls", "ms", title="where an iteration's time goes: medians, all of a kernel's calls")
    spent = {name: statistics.median(seconds) * len(seconds) / REPEATS for name, seconds in kernels.items()}
    for name, seconds in sorted(spent.items(), key=lambda item: -item[1]):
        table.add_row(name.removeprefix("refgs_"), f"{len(kernels[name]) / REPEATS:.0f}", f"{1e3 * seconds:.2f}")
    rest = statistics.median(parts["a whole iteration"]) - sum(spent.values())
    table.add_row("Python and torch: memory, autograd, small steps", "", f"{1e3 * rest:.2f}")
    console.print(table)


def _one(trainer: Trainer, rows: dict[str, list[float]]) -> None:
    """An iteration in pieces, then a whole one."""
    photo, settings, clock = trainer.state.photos[0], trainer.state.settings, time.perf_counter

    def record(name: str, since: float) -> float:
        rows.setdefault(name, []).append(clock() - since)
        return clock()

    at = clock()
    surfels, environment = trainer.state.surfels(), trainer.state.environment()
    at = record("activations and light's prefilter", at)
    rendering = render(
        surfels, environment, photo.camera, trainer.state.background, settings.render, trainer.state.near
    )
    at = record("raster and shading", at)
    loss, _ = objective(
        rendering, mean_radiance(trainer.state, environment), photo, trainer.state.background, settings.loss, 0.5
    )
    at = record("losses", at)
    loss.backward()
    record("backward of all", at)
    trainer.state.forget_gradients()
    at = clock()
    trainer.step()
    record("a whole iteration", at)


def _watch(times: dict[str, list[float]]) -> None:
    """Have the seconds of each kernel written down from here on."""

    def timed(name: str, call: Callable, *arguments) -> None:
        at = time.perf_counter()
        call(*arguments)
        times.setdefault(name, []).append(time.perf_counter() - at)

    class Library:
        def __getattr__(self, name: str):
            function = getattr(library, name)
            return (lambda *arguments: timed(name, function, *arguments)) if name in ALONE else function

    library, parallel = load.kernels(), load.parallel

    def watched(function: Callable, work, *sizes: int) -> None:
        timed(function.__name__, parallel, function, work, *sizes)

    load.parallel = raster_cpu.parallel = watched
    raster_cpu.kernels = Library


if __name__ == "__main__":
    main()
