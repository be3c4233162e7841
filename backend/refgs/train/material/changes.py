"""Measure how much the object's radiance changes with the viewing direction. Nothing here needs correct normals."""

import torch
from torch import Tensor

from refgs.color import srgb_encode
from refgs.train.material.observe import Observations


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
