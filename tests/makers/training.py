"""Make trainings that are small enough for a test, and compare what they learned."""

from pathlib import Path

import torch

from refgs.capture import read_capture
from refgs.run import create_run, open_run
from refgs.settings import load_settings
from refgs.train.asset import write_asset
from refgs.train.trainer import Trainer

SMALL = [
    "surfels.start=1500",
    "surfels.budget=1800",
    "surfels.hull=64",
    "environment.resolution=16",
    "train.light_first=20",
]
TINY = ["surfels.start=600", "surfels.budget=800", "surfels.hull=48", "train.light_first=0"]


def trainer(
    capture, folder, *changes, total=150, preset="quick", report=lambda event, facts: None, device="cpu"
) -> Trainer:
    """Return a small trainer that is ready to run; create its run folder if it is missing.

    `capture` is a capture or its folder, `total` the number of iterations. `changes` are further settings, as "section.name=value".
    """
    settings = load_settings(preset, [*SMALL, f"train.iterations={total}", *changes])
    if isinstance(capture, Path):
        capture = read_capture(capture, settings.region)
    made = Trainer(capture, settings, folder, report, device=device)
    if not folder.exists():
        create_run(folder, capture, made.state.settings, preset, "cpu", made.state.effective.chosen())
    return made


def trained(*arguments, **options) -> Trainer:
    """Make a trainer as `trainer` does with these arguments; train to the end and write the asset."""
    made = trainer(*arguments, **options)
    made.run()
    write_asset(made.state)
    return made


def learned(made: Trainer) -> dict[str, torch.Tensor]:
    """Copy the learned parameters of the surfels, by name, and the light."""
    return {name: v.detach().clone() for name, v in (made.state.parameters | {"light": made.state.light}).items()}


def check_equal(one: Trainer, other: Trainer) -> None:
    """Check that two trainings made the same decisions and learned the same values, bit for bit."""
    assert one.state.decided == other.state.decided
    torch.testing.assert_close(learned(one), learned(other), rtol=0, atol=0)


def put(made: Trainer, **values) -> None:
    """Set parameters of all surfels, by name, to one raw value each (before the activation)."""
    with torch.no_grad():
        for name, value in values.items():
            made.state.parameters[name][:] = torch.as_tensor(value)


def asset_error(made: Trainer) -> float:
    """Compute by how much a held-out view rendered from the run folder differs from the training's: the mean absolute difference."""
    camera = made.state.test[0].camera
    return float((made.state.render(camera).color - open_run(made.state.folder).render(camera).color).abs().mean())
