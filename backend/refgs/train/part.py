"""Give a part of a training its own memory, which checkpoints keep."""

from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor

from refgs.train.state import State

Fact = bool | int | Tensor


class Part:
    """Hold the memory of one task of a training, such as aligning poses. `state.part(Kind)` returns the part of the class `Kind`.

    `train/timeline.py` says when each part acts. A checkpoint stores the part's `facts` under its `name`: numbers in the TOML file, and
    tensors. By default, the facts are the attributes named in `saved` that are not None.
    """

    name: ClassVar[str]
    saved: ClassVar[tuple[str, ...]] = ()

    def start(self, state: State) -> None:
        """Make the memory. Photos and surfels exist already."""

    def facts(self, state: State) -> dict[str, Fact]:
        """Return the facts that a checkpoint keeps."""
        return {name: value for name in self.saved if (value := getattr(self, name)) is not None}

    def restore(self, state: State, facts: Mapping[str, Any]) -> None:
        """Restore the memory from the facts in a checkpoint."""
        for name in self.saved:
            setattr(self, name, facts.get(name))
