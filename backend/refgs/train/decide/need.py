"""Define `Need`, an optional part of the training such as inter-reflection, and `Decision`, whether a scene needs it."""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import ClassVar, Literal, NamedTuple

from refgs.formats.needs import Found
from refgs.train.state import State

Moment = Literal["photos", "start", "specular", "light", "degrees", "mesh", "asset"]
"""Moments at which needs are decided:

- "photos": photos are read
- "start": parameters are ready
- "specular", "light", "degrees": the row of this need in the timeline is due
- "mesh": a mesh is made
- "asset": the asset is written
"""

ASKED = "its setting leaves it out"
NUMBER = 4 * 4  # bytes: a float, its derivative and Adam's two moments
MEGA = 1e6


class Decision(NamedTuple):
    """Hold the decision whether a scene needs an optional part of the training.

    `statistic` is the measured value that was compared with `threshold`. If `threshold` is None, it was compared with `Need.threshold`.
    `figures` holds what leaving the part out saves (`seconds`, `megabytes`) and costs (`decibels`, the PSNR lost on training views). It
    also holds the values that `Need.apply` uses.
    """

    needed: bool
    why: str
    figures: Mapping[str, float] = MappingProxyType({})
    statistic: float | None = None
    threshold: float | None = None
    # Called once, when this is decided. Its result is in checkpoints, or each start makes it again.
    once: Callable[[], None] = lambda: None


class Given(NamedTuple):
    """Hold values that are measured beforehand, and passed to `Need.measure`.

    - `done`: how many iterations are done.
    - `hidden`: the fraction of the object's pixels that mirror the object.
    - `common`: which of metallic and roughness have about the same value in all surfels of splats.ply (see `Constants.common`).
    - `kept`: the number of surfels in splats.ply.
    """

    done: int = 0
    hidden: float = 0.0
    common: Mapping[str, tuple[float, float]] = MappingProxyType({})
    kept: int = 0


class Need:
    """Describe an optional part of training, and how to decide whether a scene needs it."""

    name: ClassVar[str]  # also the key in the settings' `needs`
    what: ClassVar[str]  # words that the artist reads
    shown: ClassVar[bool] = False  # tell the artist if it is left out; other decisions are details
    threshold: ClassVar[float] = math.nan
    reason: ClassVar[str] = ""  # why the threshold is what it is
    moments: ClassVar[tuple[Moment, ...]]
    follows: ClassVar[str] = ""  # name of another need: this one is decided after it as well, and taken back with it

    def due(self, state: State, moment: Moment) -> bool:
        """Tell whether to decide about this optional part now, at this moment of the training.

        This method is not called if the user's setting is "on", or if the decision has already been made.
        """
        return True

    def measure(self, state: State, given: Given) -> Decision | None:
        """Decide whether the scene needs this part; None means that nothing is decided."""
        raise NotImplementedError

    def apply(self, state: State, found: Found) -> None:
        """Leave this optional part of the training out. The decision was that the scene does not need it.

        The training calls this method once after the decision, and again when a run is resumed. `found` is the recorded decision.
        """

    def undo(self, state: State, why: str) -> None:
        """Bring this optional part of the training back, after `apply` has left it out. `why` is the reason, for the record.

        Only parts whose decision can be taken back have this method. It may be called again after a return to an earlier checkpoint.
        """
        raise NotImplementedError

    def asked(self, state: State) -> str:
        """Return the user's setting for this optional part of the training: "auto", "on" or "off"."""
        return getattr(state.settings.needs, self.name)


def megabytes(state: State, names: tuple[str, ...]) -> float:
    """Compute how many MB it takes to train these parameters (values, gradients, Adam's moments)."""
    return sum(state.learned[name].numel() for name in names if name in state.learned) * NUMBER / MEGA
