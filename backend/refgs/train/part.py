"""Give a part of a training a memory of its own, which checkpoints keep."""

from collections.abc import Mapping
from typing import ClassVar

from torch import Tensor

from refgs.train.state import State

Fact = bool | int | float | str


class Part:
    """Remember what one part of a training has found. `state.part(Kind)` returns the part of this kind.

    What is done with it and when is in `train/timeline.py`; a checkpoint has its facts and tensors under its `name`.
    """

    name: ClassVar[str]

    def start(self, state: State) -> None:
        """Make the memory. The state has its photos, but may have no surfels yet."""

    def facts(self, state: State) -> dict[str, Fact]:
        """Return what a checkpoint keeps of the memory in its TOML file."""
        return {}

    def tensors(self, state: State) -> dict[str, Tensor]:
        """Return what a checkpoint keeps of the memory as tensors."""
        return {}

    def restore(self, state: State, facts: Mapping[str, Fact], tensors: Mapping[str, Tensor]) -> None:
        """Take the memory over from a checkpoint. Facts that an earlier release did not write are missing."""
