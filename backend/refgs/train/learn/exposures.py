"""Keep the photos' white balances neutral in the mean, and stop learning exposures or white balances that turn out to be about the same."""

import math

import torch

from refgs.train.state import State
from refgs.train.timeline import faint_now

KNOWN = 0.3  # part of the training after which exposures are known well enough to judge
# A third of a stop, the step of a camera's dial: smaller differences may be errors of the shading.
ALIKE = math.log(2) / 3
BALANCED = 0.1  # largest difference of a channel's logarithm that may be an error of the shading, too


@torch.no_grad()
def balance(state: State) -> None:
    """Make the photos' white balances neutral in the mean. Without this, a coloured light in all photos could not be told from theirs."""
    weights = state.learned.get("exposure")
    if weights is not None and weights.shape[1] > 1:
        weights[:, 1:] -= weights[:, 1:].mean(dim=0)


@torch.no_grad()
def leave_out_alike(state: State, progress: float) -> None:
    """Stop learning exposures, or only white balances, if the learned ones are nearly equal and `light.exposure` is "auto"."""
    settings = state.settings
    if "exposure" not in state.learned or settings.light.exposure != "auto" or state.initial:
        return
    if state.iteration % settings.densify.every or progress < KNOWN or faint_now(state):
        return
    logarithms = state.exposure(slice(None)).log()
    brightness = logarithms.mean(dim=1)
    tint = logarithms - brightness[:, None]
    apart = [(value - value.median(dim=0).values).abs().max() for value in (brightness, tint)]
    brightness, tint = torch.stack(apart).tolist()  # a card waits here, once in a while
    if tint >= BALANCED:
        return
    if brightness < ALIKE:
        state.learned.drop("exposure")
        state.announce("exposures", "the photos have no exposures of their own: they agree within a third of a stop")
    elif state.learned["exposure"].shape[1] > 1:
        state.learned.columns("exposure", 1)
        state.announce("exposures", "the photos differ in exposure, but not in white balance")
