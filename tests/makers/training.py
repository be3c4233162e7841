"""Start trainings that are small enough for a test."""

from refgs.capture import read_capture
from refgs.run import create_run
from refgs.settings import load_settings
from refgs.train.trainer import Trainer

SMALL = [
    "surfels.start=1500",
    "surfels.budget=1800",
    "surfels.hull=64",
    "environment.resolution=16",
    "train.light_first=20",
]


def trainer(capture_folder, folder, *changes, total=150):
    """Return a small trainer that is ready to run; create its run folder if it is missing."""
    settings = load_settings("quick", [*SMALL, f"train.iterations={total}", *changes])
    capture = read_capture(capture_folder, settings.region)
    made = Trainer(capture, settings, folder, lambda event, facts: None)
    if not folder.exists():
        create_run(folder, capture, settings, "quick", "cpu")
    return made
