"""Stop learning the photos' exposures, if all of them turn out to be about the same."""

import math

import torch

from refgs.train.densify import faint_now
from refgs.train.state import State

KNOWN = 0.3  # part of the training after which exposures are known well enough to judge
# A third of a stop, the step of a camera's dial: smaller differences may be errors of the shading.
ALIKE = math.log(2) / 3


@torch.no_grad()
def leave_out_alike(state: State, progress: float) -> None:
    """Stop learning exposures if the learned ones are nearly equal and the setting `light.exposure` is "auto"."""
    settings = state.settings
    if state.exposures is None or settings.light.exposure != "auto" or state.initial:
        return
    if state.iteration % settings.densify.every or progress < KNOWN or faint_now(state):
        return
    spread = float((state.exposures - state.exposures.median()).abs().max())  # a card waits here, once in a while
    if spread < ALIKE:
        state.without_exposures()
        state.announce("exposures", "the photos have no exposures of their own: they agree within a third of a stop")
