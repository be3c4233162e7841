"""Define `Part`: the values that one task of a training remembers between iterations. Checkpoints store them."""

from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor

from refgs.train.state import State

Fact = bool | int | Tensor


class Part:
    """Hold what one task of a training remembers, such as aligning poses. `state.part(Kind)` returns the object of the subclass `Kind`.

    `train/timeline.py` says when each task is done. A checkpoint stores the object's `facts`, numbers and tensors, under its `name`. By
    default, the facts are the attributes named in `saved` that are not None.
    """

    name: ClassVar[str]
    saved: ClassVar[tuple[str, ...]] = ()

    def start(self, state: State) -> None:
        """Set the initial values. The state has its photos and surfels already."""

    def facts(self, state: State) -> dict[str, Fact]:
        """Return the values to store in a checkpoint, numbers and tensors by name."""
        return {name: value for name in self.saved if (value := getattr(self, name)) is not None}

    def restore(self, state: State, facts: Mapping[str, Any]) -> None:
        """Set the values to those from a checkpoint (see `facts`)."""
        for name in self.saved:
            setattr(self, name, facts.get(name))
