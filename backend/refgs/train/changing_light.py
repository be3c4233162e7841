"""Tell what mirrors a light that stands still from what is matte, under a light that changes from photo to photo.

Clouds, a lamp that is carried along, or the photographer's shadow change the radiance of a matte surface along its own colour, as a
coloured metal changes with the view. In each photo, such a change is nearly linear in the surface's normal (Ramamoorthi and Hanrahan 2001),
whatever it is in other photos. What is mirrored is one function of the mirrored direction, the same in all photos.
"""

import torch
from torch import Tensor

from refgs.render.relight import mirror, sphere
from refgs.train.view_dependence import LEAST_PIXELS, LEAST_VIEWS, Observations, averaged, neighbours, pooled

SURFELS = 3000  # that are looked at, at the most
LEAST_SURFELS = 100  # fewer tell nothing
SMOOTHED = 32  # neighbours whose normals are averaged: those of single surfels are rough early in the training
LOBES, SHARPNESS = 50, 10.0  # of the function of the mirrored direction: lobes 0.3 radians wide, which cover the sphere
RIDGE = 1e-3  # of the columns' mean square
CELL = 0.15  # scene radii: one half of the cells of a grid is fitted, and the other half tells how well


@torch.no_grad()
def explained(observations: Observations, positions: Tensor, radius: float, wanted: Tensor) -> tuple[float, float]:
    """Measure how much of the surface's changes a light that changed explains, and how much of the rest is explained by what it mirrors.

    The first result is the part of the variance that each photo's exposure and a linear function of the normal explain. The second is the
    part of what they leave that a function of the mirrored direction explains. Both are measured on surfels that were not fitted to.
    Changes and normals are averaged over neighbours. Only the surfels `wanted` (N,) count; if they are too few, both are 0. `radius` is the
    scene's.
    """
    near = neighbours(positions, SMOOTHED)
    mean, change, known = averaged(observations, near)
    known &= wanted[:, None] & (known.sum(dim=1, keepdim=True) >= LEAST_VIEWS)
    chosen = known.any(dim=1).nonzero()[:, 0]
    if len(chosen) < LEAST_SURFELS:
        return 0.0, 0.0
    chosen = chosen[:: -(-len(chosen) // SURFELS)]
    surfel, photo = known[chosen].nonzero(as_tuple=True)
    at = chosen[surfel]
    weight = observations.pixels[at, photo].double().clamp_min(LEAST_PIXELS)
    relative = (change[at, photo].mean(dim=1) / mean[at].mean(dim=1).clamp_min(1e-2)).clamp(-1, 2).double()
    smooth = torch.nn.functional.normalize(
        pooled(observations.normal.flatten(1), near).view_as(observations.normal), dim=2
    )
    normal, towards = smooth[at, photo].double(), observations.towards[at, photo].double()
    mirrored = mirror(-towards, normal)
    of_photo = torch.nn.functional.one_hot(photo, observations.pixels.shape[1]).double()
    linear = torch.cat([torch.ones_like(weight)[:, None], normal], dim=1)
    lobes = (SHARPNESS * (mirrored @ torch.from_numpy(sphere(LOBES)).to(weight).T - 1)).exp()
    lit = (of_photo[:, :, None] * linear[:, None]).flatten(1)
    columns = torch.cat([relative[:, None], lit, lobes], dim=1)
    total = columns.new_zeros(len(chosen), columns.shape[1]).index_add_(0, surfel, weight[:, None] * columns)
    weights = weight.new_zeros(len(chosen)).index_add_(0, surfel, weight)
    columns = columns - (total / weights[:, None])[surfel]
    fitted = ((positions[at] / (CELL * radius)).floor().sum(dim=1) % 2) == 0
    target, columns = columns[:, 0], columns[:, 1:]
    lit_left, left = (_unexplained(target, part, weight, fitted) for part in (columns[:, : lit.shape[1]], columns))
    unlit = _mean_square(target, weight, ~fitted)
    return tuple(max(0.0, 1 - after / max(before, 1e-12)) for before, after in ((unlit, lit_left), (lit_left, left)))


def _unexplained(target: Tensor, columns: Tensor, weight: Tensor, fitted: Tensor) -> float:
    """Return the mean square that `columns`, fitted to `target` by ridge regression, leave of it where they are not `fitted`."""
    rows = columns[fitted] * weight[fitted, None]
    square = rows.T @ columns[fitted]
    ridge = RIDGE * square.diagonal().mean().clamp_min(1e-12) * torch.eye(len(square)).to(square)
    return _mean_square(target - columns @ torch.linalg.solve(square + ridge, rows.T @ target[fitted]), weight, ~fitted)


def _mean_square(values: Tensor, weight: Tensor, chosen: Tensor) -> float:
    return float((weight * values.square())[chosen].sum() / weight[chosen].sum().clamp_min(1e-12))
