"""Give a part of a training a memory of its own, which checkpoints keep."""

from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor

from refgs.train.state import State

Fact = bool | int | Tensor


class Part:
    """Remember what one part of a training has found. `state.part(Kind)` returns the part of this kind.

    What is done with it and when is in `train/timeline.py`. A checkpoint has its `facts` under its `name`: numbers in the TOML file, and
    tensors. By default these are the attributes `saved`, those that are not None.
    """

    name: ClassVar[str]
    saved: ClassVar[tuple[str, ...]] = ()

    def start(self, state: State) -> None:
        """Make the memory. Photos and surfels are there."""

    def facts(self, state: State) -> dict[str, Fact]:
        """Return what a checkpoint keeps of the memory."""
        return {name: value for name in self.saved if (value := getattr(self, name)) is not None}

    def restore(self, state: State, facts: Mapping[str, Any]) -> None:
        """Take the memory over from a checkpoint."""
        for name in self.saved:
            setattr(self, name, facts.get(name))
