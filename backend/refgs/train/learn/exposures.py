"""Learn each photo's exposure and white balance. Stop learning them if they turn out to be about the same in all photos."""

import math

import torch
from torch import Tensor

from refgs.train.part import Part
from refgs.train.state import State
from refgs.train.timeline import Step

# Ways in which a photo's response may change, as logarithms of factors of red, green and blue: brightness, temperature and tint. The last
# two are the white balance. They are scaled down so that they learn more slowly, because photos differ less in them.
EXPOSURE = (1.0, 1.0, 1.0), (0.5, 0.0, -0.5), (-0.25, 0.5, -0.25)
ALIKE = math.log(2) / 3  # a third of a stop, as on a camera's dial; less may be an error of the shading
BALANCED = 0.1  # largest difference of a channel's logarithm that may still be an error of the shading


class Exposures(Part):
    """Hold `basis` (3, 3), whose rows are log RGB factors of brightness, temperature and tint."""

    name = "exposures"

    def start(self, state: State) -> None:
        self.basis = torch.tensor(EXPOSURE, device=state.device)


def exposure(state: State, view: int | slice) -> Tensor | None:
    """Return a view's exposure (3,): factors for its rendered red, green and blue. Return None if exposures are not learned.

    The training learns up to three weights per view, one for each row of EXPOSURE: brightness, temperature and tint. The weighted sum of
    the rows is the natural logarithm of the factors. If only the first weight is learned, a view's three factors are equal, because all
    photos have the same white balance. If `view` is a slice, the result has a row for each view in the slice (V, 3).
    """
    weights = state.learned.get("exposure")
    return None if weights is None else (weights[view] @ state.part(Exposures).basis[: weights.shape[1]]).exp()


@torch.no_grad()
def balance(state: State, step: Step) -> None:
    """Make the mean white balance of all photos neutral."""
    weights = state.learned.get("exposure")
    if weights is not None and weights.shape[1] > 1:
        weights[:, 1:] -= weights[:, 1:].mean(dim=0)


@torch.no_grad()
def leave_out_alike(state: State, step: Step) -> None:
    """Stop learning exposures or white balances that hardly differ, if `light.exposure` is "auto"."""
    exposures = exposure(state, slice(None))
    if exposures is None or state.settings.light.exposure != "auto":
        return
    logarithms = exposures.log()
    brightness = logarithms.mean(dim=1)
    tint = logarithms - brightness[:, None]
    apart = [(value - value.median(dim=0).values).abs().max() for value in (brightness, tint)]
    differs, tinted = torch.stack(apart).tolist()  # this waits for the graphics card, but rarely
    if tinted >= BALANCED:
        return
    if differs < ALIKE:
        state.learned.drop("exposure")
        state.announce("exposures", "the photos have no exposures of their own: all within 1/3 of a stop", detail=True)
    elif state.learned["exposure"].shape[1] > 1:
        state.learned.columns("exposure", 1)
        state.announce("exposures", "the photos differ in exposure, but not in white balance", detail=True)
