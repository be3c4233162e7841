"""Tell what mirrors a light that stands still from what is matte, under a light that changes from photo to photo.

Clouds, a lamp that is carried along, or the photographer's shadow change the radiance of a matte surface along its own colour, as a
coloured metal changes with the view. In each photo, such a change is nearly linear in the surface's normal (Ramamoorthi and Hanrahan 2001),
whatever it is in other photos. What is mirrored is one function of the mirrored direction, the same in all photos.
"""

import torch
from torch import Tensor

from refgs.render.relight import sphere
from refgs.train.view_dependence import Observations

SURFELS = 3000  # that are looked at, at the most
LEAST_SURFELS = 100  # fewer tell nothing
LOBES, SHARPNESS = 50, 10.0  # of the function of the mirrored direction: lobes 0.3 radians wide, which cover the sphere
RIDGE = 1e-3  # of the columns' mean square
CELL = 0.15  # scene radii: one half of the cells of a grid is fitted, and the other half tells how well


@torch.no_grad()
def part_mirrored(observations: Observations, positions: Tensor, radius: float, wanted: Tensor) -> float | None:
    """Measure how much of the surface's changes is explained by what it mirrors, and by nothing else.

    First each photo's exposure and a linear function of the normal explain what they can. The result is the part of the remaining variance
    that a function of the mirrored direction explains on surfels that it was not fitted to, 0 to 1. Only the surfels `wanted` (N,) count;
    if they are too few, the result is None. `radius` is the scene's.
    """
    known = observations.usable & wanted[:, None]
    chosen = known.any(dim=1).nonzero()[:, 0]
    if len(chosen) < LEAST_SURFELS:
        return None
    chosen = chosen[:: -(-len(chosen) // SURFELS)]
    surfel, photo = known[chosen].nonzero(as_tuple=True)
    at = chosen[surfel]
    weight = observations.pixels[at, photo].double()
    brightness = observations.mean[at].mean(dim=1).clamp_min(1e-2)
    change = (observations.change[at, photo].mean(dim=1) / brightness).clamp(-1, 2).double()
    of_photo = torch.nn.functional.one_hot(photo, observations.pixels.shape[1]).double()
    linear = torch.cat([torch.ones_like(weight)[:, None], observations.normal[at, photo].double()], dim=1)
    mirrored = observations.mirrored[at, photo].double() @ torch.from_numpy(sphere(LOBES)).to(weight).T
    lit = (of_photo[:, :, None] * linear[:, None]).flatten(1)
    columns = torch.cat([change[:, None], lit, (SHARPNESS * (mirrored - 1)).exp()], dim=1)
    total = columns.new_zeros(len(chosen), columns.shape[1]).index_add_(0, surfel, weight[:, None] * columns)
    weights = weight.new_zeros(len(chosen)).index_add_(0, surfel, weight)
    columns = columns - (total / weights[:, None])[surfel]
    fitted = ((positions[at] / (CELL * radius)).floor().sum(dim=1) % 2) == 0
    target, columns = columns[:, 0], columns[:, 1:]
    without, all_explain = (_left(target, part, weight, fitted) for part in (columns[:, : lit.shape[1]], columns))
    return max(0.0, 1 - all_explain / max(without, 1e-12))


def _left(target: Tensor, columns: Tensor, weight: Tensor, fitted: Tensor) -> float:
    """Return the mean square of `target` that `columns` leave where they are not `fitted`. The fit is a ridge regression."""
    rows = columns[fitted] * weight[fitted, None]
    square = rows.T @ columns[fitted]
    ridge = RIDGE * square.diagonal().mean().clamp_min(1e-12) * torch.eye(len(square)).to(square)
    error = target - columns @ torch.linalg.solve(square + ridge, rows.T @ target[fitted])
    return float((weight * error.square())[~fitted].sum() / weight[~fitted].sum().clamp_min(1e-12))
