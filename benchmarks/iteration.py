"""Time a training iteration with deferred shading, and each part of it.

The parts are the functions that an iteration calls, such as rasteriser and losses. The photos show a metal ball and are computed without
Blender: 256×256 pixels, of which the ball fills most. 20,000 surfels start on the ball's visual hull.
"""

import refgs  # noqa: F401, I001  first: it sets how OpenMP's idle threads wait, which torch reads when it loads

import tempfile
import time
from pathlib import Path

from benchmarks.scenes.analytic import write_ball_capture

from refgs.capture import read_capture
from refgs.render.renderer import render
from refgs.settings import load_settings
from refgs.train.learn.light import mean_radiance
from refgs.train.learn.losses import objective
from refgs.train.trainer import Trainer

SIZE, SURFELS, REPEATS = 256, 20_000, 30


def make_trainer(folder: Path, device: str = "cpu") -> Trainer:
    """Start a training on photos of a ball, and run its first five iterations."""
    write_ball_capture(folder / "ball", SIZE, samples=2)
    changes = [f"surfels.start={SURFELS}", f"surfels.budget={SURFELS}", "train.light_first=0"]
    settings = load_settings("quick", changes)
    trainer = Trainer(read_capture(folder / "ball"), settings, folder, lambda *_: None, device=device)
    for _ in range(5):
        trainer.step()
    return trainer


def measure() -> dict[str, list[float]]:
    """Time REPEATS iterations. Return the seconds of each part and of the whole iteration, in lists with one number per iteration."""
    parts: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        trainer = make_trainer(Path(folder))
        for _ in range(REPEATS):
            _time_parts(trainer, parts)
    return parts


def _time_parts(trainer: Trainer, rows: dict[str, list[float]]) -> None:
    """Time each part of an iteration, then one whole iteration.

    `rows` maps the names of the parts to lists of seconds, to which the new times are appended.
    """
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
    trainer.state.learned.forget_gradients()
    at = clock()
    trainer.step()
    record("a whole iteration", at)
