"""Learn a photo's exposure and white balance, and stop learning those that turn out to be about the same in all photos."""

import math

import torch
from torch import Tensor

from refgs.train.part import Part
from refgs.train.state import State
from refgs.train.timeline import Step

# Changes of a photo's response, as logarithms of factors of red, green and blue: brightness, then temperature and tint, which are its white
# balance. The latter two are scaled down so that they learn more slowly: photos differ less in them.
EXPOSURE = (1.0, 1.0, 1.0), (0.5, 0.0, -0.5), (-0.25, 0.5, -0.25)
# A third of a stop, the step of a camera's dial: smaller differences may be errors of the shading.
ALIKE = math.log(2) / 3
BALANCED = 0.1  # largest difference of a channel's logarithm that may be an error of the shading, too


class Exposures(Part):
    """Hold EXPOSURE on the training's device."""

    name = "exposures"

    def start(self, state: State) -> None:
        self.basis = torch.tensor(EXPOSURE, device=state.device)


def exposure(state: State, view: int | slice) -> Tensor | None:
    """Compute a view's exposure (3,): factors of its rendered red, green and blue. Return None if exposures are not learned.

    What is learned are the weights of the rows of EXPOSURE in the factors' natural logarithms. If it has only one column, the photos have
    the same white balance, and a view's three factors are equal. A slice of views gives the exposures of all of them (V, 3).
    """
    weights = state.learned.get("exposure")
    return None if weights is None else (weights[view] @ state.part(Exposures).basis[: weights.shape[1]]).exp()


@torch.no_grad()
def balance(state: State, step: Step) -> None:
    """Make the photos' white balances neutral in the mean. Without this, a coloured light in all photos could not be told from theirs."""
    weights = state.learned.get("exposure")
    if weights is not None and weights.shape[1] > 1:
        weights[:, 1:] -= weights[:, 1:].mean(dim=0)


@torch.no_grad()
def leave_out_alike(state: State, step: Step) -> None:
    """Stop learning exposures, or only white balances, if the learned ones are nearly equal and `light.exposure` is "auto"."""
    exposures = exposure(state, slice(None))
    if exposures is None or state.settings.light.exposure != "auto":
        return
    logarithms = exposures.log()
    brightness = logarithms.mean(dim=1)
    tint = logarithms - brightness[:, None]
    apart = [(value - value.median(dim=0).values).abs().max() for value in (brightness, tint)]
    differs, tinted = torch.stack(apart).tolist()  # a card waits here, once in a while
    if tinted >= BALANCED:
        return
    if differs < ALIKE:
        state.learned.drop("exposure")
        state.announce("exposures", "the photos have no exposures of their own: they agree within a third of a stop")
    elif state.learned["exposure"].shape[1] > 1:
        state.learned.columns("exposure", 1)
        state.announce("exposures", "the photos differ in exposure, but not in white balance")
