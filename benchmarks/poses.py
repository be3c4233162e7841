"""Disturb a capture's poses, and measure how much of the error pose refinement undoes: `refgs bench poses CAPTURE…`.

Each capture is trained with its own poses and with disturbed ones, with and without refinement. All views are disturbed, held-out views
too. So every run is measured in the same way: the pose of each held-out view is first fitted to its photo, while surfels and light rest.
"""

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from refgs.capture import Capture, read_capture
from refgs.compare import metrics
from refgs.compare.pictures import as_bytes, composite, write_png
from refgs.render.align import fitted
from refgs.settings import load_settings
from refgs.spread import spread
from refgs.train.keep.measures import held_out_psnr
from refgs.train.learn.poses import Poses, shifts
from refgs.train.state import State
from refgs.train.trainer import Trainer

VIEWS = 4  # held-out views whose poses are fitted
DEGREES, PART = 0.5, 0.01  # root mean squares: of the rotation angle, and of the translation in scene radii


def disturbed(capture: Capture, seed: int = 0) -> Capture:
    """Turn each camera about itself by about DEGREES, and move it by about PART of the scene's radius, at random."""
    generator, views = np.random.default_rng(seed), []
    for view in capture.views:
        turn, shift = generator.normal(size=(2, 3)) / np.sqrt(3)
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec(np.radians(DEGREES) * turn).as_matrix()
        motion[:3, 3] = PART * capture.radius * shift
        views.append(replace(view, camera=replace(view.camera, world_to_camera=motion @ view.camera.world_to_camera)))
    return replace(capture, views=views)


def fitted_psnr(state: State, pictures: Path | None = None) -> float:
    """Average the PSNR of the held-out views, each after its pose was fitted to its photo."""
    found: list[float] = []
    for view in spread(state.test, VIEWS):
        photo = composite(view, state.background)
        camera = fitted(state.render, view.camera, photo, state.capture.centre, state.capture.radius)
        shown = state.render(camera).color.clamp(0, 1).numpy(force=True)
        found.append(metrics.psnr(shown, photo.numpy(force=True)))
        if pictures and len(found) <= 2:
            both = np.concatenate([photo.numpy(force=True), shown], axis=1)
            write_png(pictures / f"{view.camera.name}.png", as_bytes(both))
    return float(np.mean(found))


def main(arguments: Sequence[str] | None = None) -> None:
    """Train and measure the runs of all captures, and print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--set", action="append", default=[], dest="changes", help="a setting, section.key=value")
    parser.add_argument("--preset", default="quick")
    parser.add_argument("--only", default="exact-off exact-auto disturbed-off disturbed-auto", help="runs to make")
    parser.add_argument("--pictures", type=Path, help="folder for held-out photos beside their renderings")
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    print("| capture | poses | refinement | PSNR, given poses | PSNR, fitted poses | median shift, px | seconds |")
    print("|---|---|---|---|---|---|---|")
    for folder in given.captures:
        for run in given.only.split():
            poses, refine = run.split("-")
            settings = load_settings(given.preset, [*given.changes, f"cameras.poses={refine}"])
            capture = read_capture(folder, settings.region)
            if poses == "disturbed":
                capture = disturbed(capture)
            with tempfile.TemporaryDirectory() as scratch:
                trainer = Trainer(capture, settings, Path(scratch), lambda *event: None)
                begun, state = time.process_time(), trainer.state
                trainer.run()
            seconds = time.process_time() - begun
            moved = f"{np.median(shifts(state)):.2f}" if state.part(Poses).values is not None else "–"
            figures = (
                held_out_psnr(state, len(state.test)),
                fitted_psnr(state, given.pictures and given.pictures / f"{folder.name}_{run}"),
            )
            print(
                f"| {folder.name} | {poses} | {refine} | {figures[0]:.2f} | {figures[1]:.2f} | {moved} | {seconds:.0f} |",
                state.decided.get("poses", ""),
                flush=True,
            )
