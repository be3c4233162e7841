"""Measure how the object's radiance changes with the viewing direction, and whether it changes as a metal's does.

Nothing here needs correct normals. An embossed metal has no sharp reflections, yet the radiance of each of its points changes from photo to
photo. A matte surface under a light that stands still looks the same from everywhere.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from refgs.color import srgb_encode
from refgs.train.material.observe import (
    LEAST_VIEWS,
    NEIGHBOURS,
    Observations,
    averaged,
    from_grey,
    neighbours,
    pooled,
)

FEW = 32  # neighbours, where the size of a change is asked and not its colour: averaging over more would even it out
SATURATED = 0.08  # distance from grey; below it, metals and dielectrics change alike; silver has 0.03, copper 0.14
CHANGES = 0.15  # relative to the mean radiance; smaller changes may be texture that is slightly misaligned
FAINT_CHANGES = 0.08  # enough for surfels whose neighbours change clearly, in their own colour as well
FAINTEST_CHANGES = 0.05  # may be noise, unless nearly the whole surface has it; embossed gold has 0.07 to 0.2
GROWTH = 8  # times that metals spread to their neighbours
LOW = 0.15  # quantile of a surfel's radiance at which its drop is measured; darker photos may be shadows or outlines
# Least drop, relative to the light's mean radiance; a dielectric mirrors 0.04 of the light, and cannot fall much farther below its median.
DROP = 0.08
FALLS = 0.88  # a metal, without diffuse light, falls below this fraction of its median; paint not below 0.94
METAL_TINT = 0.6  # tint of the change (0: grey as a dielectric's reflection; 1: of the surface's own colour)


class Shining(NamedTuple):
    """Hold three bool masks (N,) about surfels that look like a coloured metal: their radiance changes from view to view.

    - `clearly`: the radiance changes by more than CHANGES times its mean. Neighbours with more than FAINT_CHANGES are added.
    - `faintly`: the radiance changes by more than FAINTEST_CHANGES times its mean.
    - `tells`: the surfel can be judged, because it is coloured and enough photos show it.

    `clearly` and `faintly` mark only surfels whose radiance changes along their own colour.
    """

    clearly: Tensor
    faintly: Tensor
    tells: Tensor


@torch.no_grad()
def change_seen(observations: Observations, wanted: Tensor) -> float:
    """Measure how much the surface's colour changes with the viewing direction: a cubic mean over the surfels in the mask `wanted` (N,).

    A surfel's change is the standard deviation of its sRGB-encoded colour over the photos. Surfels are weighted by the pixels they cover. A
    cubic mean lets a small part that changes much, such as a chrome handle, count more. Returns 0..1; 0 if no photo shows the surfels well.
    """
    usable = observations.usable
    count = usable.sum(dim=1).clamp_min(2)
    mean = observations.mean[:, None]
    colour = srgb_encode((mean + observations.change).clamp(0, 1)) * usable[..., None]
    centre = colour.sum(dim=1, keepdim=True) / count[:, None, None]
    square = ((colour - centre).square().mean(dim=2) * usable).sum(dim=1) / (count - 1)
    weight = (observations.pixels * usable).sum(dim=1) * wanted
    return float(((square.pow(1.5) * weight).sum() / weight.sum().clamp_min(1e-6)) ** (1 / 3))


@torch.no_grad()
def shines_as_metal(observations: Observations, positions: Tensor) -> Shining:
    """Find the surfels whose radiance changes with the view as that of a coloured metal does.

    A metal tints what it reflects: its radiance changes along its own colour. A dielectric's reflection has the light's colour, which is
    grey on average, whatever the dielectric's own colour is. The direction of change is the first principal axis of the linear radiance
    over the photos. Radiance is first averaged over neighbouring surfels. This cancels errors by slightly misaligned texture, but not
    highlights. Surfels that are nearly grey are not judged.
    """
    near = neighbours(positions, NEIGHBOURS)
    mean, change, known = averaged(observations, near)
    count = known.sum(dim=1).clamp_min(1)[:, None, None]
    change = (change - change.sum(dim=1, keepdim=True) / count) * known[..., None]
    relative = change / mean.mean(dim=1)[:, None, None].clamp_min(1e-2)
    covariance = relative.transpose(1, 2) @ relative / count
    axis = torch.linalg.eigh(covariance).eigenvectors[:, :, 2]
    axis = axis * torch.sign(axis.sum(dim=1, keepdim=True))
    axis = axis / axis.sum(dim=1, keepdim=True).clamp_min(0.2)
    own = from_grey(mean)
    saturation = own.norm(dim=1)
    tint = ((axis - 1 / 3) * own).sum(dim=1) / saturation.square().clamp_min(1e-6)
    size = covariance.diagonal(dim1=1, dim2=2).mean(dim=1).sqrt()
    tells = (known.sum(dim=1) >= LEAST_VIEWS) & (saturation > SATURATED)
    tinted = tells & (tint > METAL_TINT)
    metal, beside = tinted & (size > CHANGES), tinted & (size > FAINT_CHANGES)
    for _ in range(GROWTH):
        metal = metal | beside & (pooled(metal.float()[:, None], near)[:, 0] > near.shape[1] / 4)
    return Shining(metal, tinted & (size > FAINTEST_CHANGES), tells)


@torch.no_grad()
def falls_as_metal(observations: Observations, positions: Tensor, light: float) -> Tensor:
    """Find surfels of any colour that must be metal, because their radiance in some photos is far below its median: a mask (N,).

    A dielectric has the same diffuse radiance in all photos, and mirrors only a twenty-fifth of the light. Highlights may make it far
    brighter, but without them it is hardly darker than its median. A metal is as dark as what it mirrors. `light` is the light's mean
    radiance. Radiance is averaged over a few neighbours, so that slightly misaligned texture hardly counts.
    """
    near = neighbours(positions, FEW)
    mean, change, known = averaged(observations, near)
    radiance = (mean[:, None] + change).mean(dim=2).clamp_min(0).masked_fill(~known, math.nan)
    median, low = radiance.nanquantile(0.5, dim=1), radiance.nanquantile(LOW, dim=1)
    usable = known.sum(dim=1) >= LEAST_VIEWS
    return usable & (median - low > DROP * light) & (low < FALLS * median)
