"""Average the loss over the last iterations, for the history and for the progress events."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from refgs.compare.metrics import decibels
from refgs.train.part import Fact, Part
from refgs.train.state import State


class Means(Part):
    """Hold running means of what `Trainer.step` returns: `loss` and `square`, the mean squared error."""

    name = "means"

    def start(self, state: State) -> None:
        self.values: dict[str, Tensor] = {}

    def facts(self, state: State) -> dict[str, Fact]:
        return {**self.values}

    def restore(self, state: State, facts: Mapping[str, Any]) -> None:
        self.values = dict(facts)

    def add(self, figures: Mapping[str, Tensor]) -> None:
        """Add the figures of an iteration to the means, without waiting for the card."""
        self.values = {name: running(self.values.get(name, figure), figure) for name, figure in figures.items()}

    @property
    def loss(self) -> float:
        """Return the mean loss."""
        return float(self.values["loss"])

    @property
    def psnr(self) -> float:
        """Return the PSNR of the training views in dB, from the mean squared error."""
        return decibels(float(self.values["square"]))


def running(mean: Tensor, figure: Tensor) -> Tensor:
    """Return the exponential running mean after `figure` (weight 0.05), which is ignored unless finite."""
    known = torch.where(mean.isfinite(), figure + 0.95 * (mean - figure), figure)
    return torch.where(figure.isfinite(), known, mean)
