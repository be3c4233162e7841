"""Keep base colours as bright as photos and experience tell, so that the light gets the right scale.

Photos of a mirror do not tell its base colour from the light: twice the light and half the base colour look the same. So silver in a dark
room is learned as dark, under a light that is too bright. But where a metal mirrors the object, photos show what it mirrors, too. The
reflectance found there (`reckoning.Reckoned`) is used as one number, the mean brightness of all metals. That of one surfel is wrong where
its normal is, and has no colour if its rays do not meet what they mirror. Colours, spots and differences between metals are learned.

Paint has the same freedom. Lamps give most of its light, and photos clip them in all mirrors. So lamps are learned too dim, and paint too
bright. Nothing in the photos contradicts, but base colours of paint are known: see PAINT.

Brightness is the brightest channel of the base colour. Means are of its logarithm, over surfels.
"""

import math

import torch
from torch import Tensor

from refgs.train.material.reckoning import Reckoned
from refgs.train.state import State

LEAST_PART = 0.05  # fraction of the metals' pixels from which on what they mirror of the object tells
# The most that all paint of a capture has in the mean. In 30 rendered scenes, the true means are 0.25 times or over 1.9, and
# photographers expose for 0.18.
PAINT = 0.4
DARKEST, BRIGHTEST = 0.02, 0.98  # base colours


def plausible(color: Tensor) -> Tensor:
    """Clamp base colours, or roughnesses with them, to DARKEST..BRIGHTEST: beyond, a logistic function hardly learns."""
    return color.clamp(DARKEST, BRIGHTEST)


def told(albedo: Tensor, found: Reckoned, metals: Tensor) -> Tensor | None:
    """Return the mean brightness that photos tell of `metals` (N,), a scalar, or None if too little of them mirrors the object.

    `albedo` (N, 3) are the base colours learned so far.
    """
    weight = found.pixels * metals
    mirrors = weight * found.by_object
    if mirrors.sum() <= LEAST_PART * weight.sum():
        return None
    learned = _brightness(albedo)
    brighter = (mirrors * (_brightness(found.reflectance) - learned)).sum() / mirrors.sum()
    return learned[metals].mean() + brighter


@torch.no_grad()
def keep(state: State, metals: Tensor, paint: Tensor, brightness: Tensor) -> None:
    """Multiply the base colours of `metals` (N,) by one factor, so that their mean is `brightness`, and those of `paint` by another.

    That of paint is one, but smaller if the mean would exceed PAINT.
    """
    raw = state.learned["albedo"]
    albedo = raw.sigmoid()
    learned = _brightness(albedo)

    def mean(which: Tensor) -> Tensor:
        return (learned * which).sum() / which.sum().clamp_min(1)

    brighter, darker = brightness - mean(metals), (math.log(PAINT) - mean(paint)).clamp_max(0)
    changed = albedo * (metals * brighter + paint * darker).exp()[:, None]
    raw.copy_(torch.where((metals | paint)[:, None], torch.logit(plausible(changed)), raw))


def _brightness(color: Tensor) -> Tensor:
    return plausible(color).amax(dim=1).log()
