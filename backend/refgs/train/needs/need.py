"""Define a need, a part of the method that a scene may do without, and the decision about it."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar, Literal, NamedTuple

from refgs.train.state import State

Moment = Literal["photos", "start", "iteration", "mesh", "asset"]
"""When needs are decided: the photos are read, parameters are ready, an iteration is done, a mesh is made, the asset is written."""

ASKED = "its setting leaves it out"
NUMBER = 4 * 4  # bytes: a float, its derivative and Adam's two moments
MEGA = 1e6


class Decision(NamedTuple):
    """Hold the decision about a need.

    `statistic` was compared with `threshold`, or with the need's own threshold if `threshold` is None. `figures` say what was saved, in
    `seconds` and `megabytes`, and what it cost, in `decibels` of the training views' PSNR. They also hold numbers that `Need.apply` reads.
    """

    needed: bool
    why: str
    figures: Mapping[str, float] = MappingProxyType({})
    statistic: float | None = None
    threshold: float | None = None
    once: Callable[[], None] = (
        lambda: None
    )  # done when it is decided; its result is in checkpoints, or made by each start


class Need:
    """Describe a part of the method that a scene may do without. `refgs.train.needs` lists all of them."""

    name: ClassVar[str]  # also in the settings' `needs`
    what: ClassVar[str]  # words for the artist
    threshold: ClassVar[float | None] = None
    reason: ClassVar[str] = ""  # for the threshold
    moments: ClassVar[tuple[Moment, ...]]
    follows: ClassVar[str] = ""  # a need after whose decision this one is asked, too

    def due(self, state: State, moment: Moment, progress: float) -> bool:
        """Tell whether to decide about this need at this moment of the training.

        This function is not called if the need's setting is "on", or if the need is decided already.
        """
        return True

    def measure(self, state: State, *given: Any) -> Decision | None:
        """Measure whether the scene needs this part of the method, and decide.

        `given` are further arguments, which depend on the moment of the training. Returns None if there is nothing to record.
        """
        raise NotImplementedError

    def apply(self, state: State, found: dict[str, Any]) -> None:
        """Leave out the part of the method that is not needed. Called after the decision, and again when a run is resumed.

        `found` is the recorded decision.
        """

    def asked(self, state: State) -> str:
        """Return the need's setting: "auto", "on" or "off"."""
        return getattr(state.settings.needs, self.name)


def megabytes(state: State, names: tuple[str, ...]) -> float:
    """Compute how much memory these parameters take while they learn, in MB."""
    return sum(state.parameters[name].numel() for name in names if name in state.parameters) * NUMBER / MEGA
