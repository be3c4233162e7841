"""Train on photos of a small metal ball, with or without a disturbance. The stability cases compare such trainings."""

import atexit
import functools
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from benchmarks.scenes.analytic import write_ball_capture
from benchmarks.stability.cases import NEVER
from refgs.capture import read_capture
from refgs.settings import load_settings
from refgs.train.keep.measures import held_out_psnr
from refgs.train.trainer import Trainer

SIZE, TOTAL, LOOK = 32, 150, 10  # pixels; iterations; iterations between measurements of held-out views
SMALL = [
    "surfels.start=500",
    "surfels.budget=600",
    "surfels.hull=48",
    "environment.resolution=16",
    "train.light_first=10",
]
SMALL += ["surfels.metallic=0.9", "densify.every=25", "train.checkpoint_every=20", "indirect.start=1"]
BACK = 1.0  # a disturbed training has recovered when it is within so many dB of the undisturbed one


@functools.cache
def workspace() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="refgs-stability-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@functools.cache
def ball(**how) -> Path:
    folder = workspace() / f"ball {how}".replace("/", " ")
    write_ball_capture(folder, SIZE, samples=2, **how)
    return folder


def changed(
    pose: Callable[[np.ndarray], np.ndarray] = lambda matrix: matrix,
    photo: Callable[[np.ndarray, int], np.ndarray] = lambda pixels, index: pixels,
    views: int | None = None,
) -> Path:
    """Copy the photos of the metal ball into a new folder with changes, and return the folder.

    `pose` changes each camera-to-world matrix. `photo` changes each photo (H, W, 4) in 0..1; its second argument is the photo's number. If
    `views` is given, only this number of training views is kept.
    """
    folder = Path(tempfile.mkdtemp(dir=workspace()))
    for split in ("train", "test"):
        frames = json.loads((ball() / f"transforms_{split}.json").read_text())
        frames["frames"] = frames["frames"][: views if split == "train" else None]
        (folder / split).mkdir()
        for i, frame in enumerate(frames["frames"]):
            frame["transform_matrix"] = pose(np.array(frame["transform_matrix"])).tolist()
            pixels = np.asarray(Image.open(ball() / f"{frame['file_path']}.png")) / 255
            made = np.rint(photo(pixels, i).clip(0, 1) * 255).astype(np.uint8)
            Image.fromarray(made).save(folder / f"{frame['file_path']}.png")
        (folder / f"transforms_{split}.json").write_text(json.dumps(frames))
    return folder


class Course(NamedTuple):
    """Hold a finished training: the held-out PSNR (dB) measured at some iterations, the warnings, and the trainer."""

    psnr: dict[int, float]
    said: list[str]
    trainer: Trainer

    @property
    def end(self) -> float:
        return max(self.psnr.items())[1]

    @property
    def finite(self) -> bool:
        values = [
            *self.trainer.state.learned.values(),
            *(v.color for v in map(self._seen, self.trainer.state.test)),
        ]
        return all(bool(value.isfinite().all()) for value in values) and all(np.isfinite(list(self.psnr.values())))

    def _seen(self, view):
        return self.trainer.state.render(view.camera)

    def back_after(self, start: int, undisturbed: "Course") -> int:
        """Count the iterations from `start` until this training has recovered. Return NEVER if it has not recovered at the end.

        It has recovered when its PSNR no longer falls more than BACK dB below that of the undisturbed training.
        """
        late = [i for i in self.psnr if i > start and self.psnr[i] < undisturbed.psnr.get(i, undisturbed.end) - BACK]
        return NEVER if late and max(late) == max(self.psnr) else max(late, default=start - LOOK) + LOOK - start


def trainer(
    capture: Path, *changes: str, total: int = TOTAL, said: list[str] | None = None, folder: Path | None = None
) -> Trainer:
    settings = load_settings("quick", [*SMALL, f"train.iterations={total}", *changes])
    folder = folder or Path(tempfile.mkdtemp(dir=workspace()))

    def report(event: str, facts: dict) -> None:
        if event == "warning" and said is not None:
            said.append(facts["what"])

    return Trainer(read_capture(capture), settings, folder, report)


def train(
    capture: Path, *changes: str, total: int = TOTAL, disturb: dict[int, Callable[[Trainer], None]] | None = None
) -> Course:
    """Train on a capture for `total` iterations, and measure the held-out PSNR every LOOK iterations.

    `changes` are settings, such as "train.seed=1". `disturb` maps iterations to functions, which are called with the trainer at that time.
    """
    said: list[str] = []
    made, psnr = trainer(capture, *changes, total=total, said=said), {}
    for end in range(LOOK, total + 1, LOOK):
        (disturb or {}).get(end - LOOK, lambda _: None)(made)
        while made.state.iteration < end and not made.state.ended:  # it may return to a checkpoint or end early
            made.run(stop=lambda end=end: made.state.iteration >= end)
        psnr[end] = held_out_psnr(made.state)
    return Course(psnr, said, made)


@functools.cache
def usual(total: int = TOTAL) -> Course:
    return train(ball(), total=total)
