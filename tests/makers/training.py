"""Make trainings that are short enough for a test, and compare what they learned."""

import copy
import shutil
from pathlib import Path

import torch

from refgs.capture import Capture, read_capture
from refgs.run import create_run, open_run
from refgs.settings import LossSettings, RegionSettings, load_settings
from refgs.train.keep.asset import write_asset
from refgs.train.state import State
from refgs.train.timeline import AFTER, BEFORE, Step
from refgs.train.trainer import Trainer, walk

SMALL = [
    "surfels.start=1500",
    "surfels.budget=1800",
    "surfels.hull=64",
    "environment.resolution=16",
    "train.light_first=20",
]
TINY = ["surfels.start=600", "surfels.budget=800", "surfels.hull=48", "train.light_first=0"]


_read: dict[tuple, Capture] = {}


def read(folder: Path, region: RegionSettings) -> Capture:
    """Read a capture, once as long as its files stay as they are: to find its region takes as long as ten iterations."""
    files = tuple((file, file.stat().st_mtime_ns) for file in sorted(folder.rglob("*")))
    key = (files, repr(region))
    if key not in _read:
        _read[key] = read_capture(folder, region)
    return copy.deepcopy(_read[key])


def copied(made: Trainer, folder: Path) -> Trainer:
    """Copy a Trainer and its run folder, to `folder`. A copy takes no time, unlike a new Trainer. It must trace no mesh yet."""
    shutil.copytree(made.state.folder, folder)
    new = copy.deepcopy(made)
    new.state.folder = folder
    return new


def trainer(
    capture, folder, *changes, total=150, preset="quick", report=lambda event, facts: None, device="cpu"
) -> Trainer:
    """Make a small Trainer that is ready to run. Create its output folder if it is missing.

    `capture` is a data set or its folder. `total` is the number of iterations. `changes` are settings, as "section.name=value". The trainer
    calls `report(event, facts)` for each event.
    """
    settings = load_settings(preset, [*SMALL, f"train.iterations={total}", *changes])
    if isinstance(capture, Path):
        capture = read(capture, settings.region)
    made = Trainer(capture, settings, folder, report, device=device)
    if not folder.exists():
        create_run(folder, capture, made.state.settings, preset, "cpu", made.state.effective.chosen())
    return made


def only(**weights: float) -> LossSettings:
    """Make weights of the loss that are all 0, but for `weights`."""
    return LossSettings(**dict.fromkeys(LossSettings.model_fields, 0) | weights)


def trained(*arguments, **options) -> Trainer:
    """Train a small scene to the end, write its results, and return the Trainer. The arguments are those of `trainer`."""
    made = trainer(*arguments, **options)
    made.run()
    write_asset(made.state)
    return made


def learned(made: Trainer) -> dict[str, torch.Tensor]:
    """Copy what a training has learned: the surfels' parameters, light ("environment") and exposures ("exposure")."""
    return {name: value.detach().clone() for name, value in made.state.learned.items()}


def check_equal(one: Trainer, other: Trainer) -> None:
    """Check that two trainings have learned the same values, bit for bit.

    The decisions that the trainer reported to the user (`state.decided`) must be the same, too.
    """
    assert one.state.decided == other.state.decided
    torch.testing.assert_close(learned(one), learned(other), rtol=0, atol=0)


def do(state: State, what: str, progress: float | None = None, done: int | None = None, hidden: float | None = None):
    """Do what the row `what` of the timeline does, if it is due at a `progress` when so many iterations are `done`; by default, now."""
    step = Step(state)
    step.progress = step.progress if progress is None else progress
    step.done = step.done if done is None else done
    step.hidden = hidden
    walk(tuple(row for row in (*BEFORE, *AFTER) if row.what == what), state, step)


def put(made: Trainer, **values) -> None:
    """Set parameters of all surfels. `values` maps a parameter's name to its new raw value (before the activation)."""
    with torch.no_grad():
        for name, value in values.items():
            made.state.learned[name][:] = torch.as_tensor(value)


def asset_error(made: Trainer) -> float:
    """Render a held-out view twice: from the training's state, and from the files it wrote. Return the mean absolute difference."""
    camera = made.state.test[0].camera
    return float((made.state.render(camera).color - open_run(made.state.folder).render(camera).color).abs().mean())
