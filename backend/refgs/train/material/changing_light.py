"""Tell mirroring surfaces from matte surfaces whose light changes from photo to photo.

The light can change because of clouds, a lamp that is carried along, or the photographer's shadow. A matte surface then changes along its
own colour, and looks like a coloured metal, which changes with the view.

Two models tell them apart. A change of the light is nearly linear in the surface normal in each photo (Ramamoorthi and Hanrahan 2001). It
can be another linear function in each photo. A mirrored picture is one function of the mirror direction, which is the same in all photos.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from refgs.render.relight import mirror, sphere
from refgs.train.material.observe import LEAST_PIXELS, LEAST_VIEWS, Observations, averaged, neighbours, pooled

SURFELS = 3000  # that are looked at, at the most
LEAST_SURFELS = 400  # fewer tell nothing
SMOOTHED = 32  # neighbours whose normals are averaged: those of single surfels are rough early in the training
LOBES, SHARPNESS = 50, 10.0  # of the function of the mirrored direction: lobes 0.3 radians wide, which cover the sphere
RIDGE = 1e-3  # of the columns' mean square
CHANGED = 0.13  # by which a changed light explains more than mirroring; matte clay has 0.19, seven metals up to 0.08, a sharp mirror 0.17
LEFT = 0.05  # part of the rest that mirroring explains, below which light changed; matte clay has 0.03, a sharp mirror 0.14
NOISE = 0.3  # part that both explain, below which changes are noise; a fox's fur has up to 0.19, six coloured metals from 0.42
CELL = 0.15  # scene radii: one half of the cells of a grid is fitted, and the other half tells how well


class Explained(NamedTuple):
    """Hold which part of the variance of a surface's changes is explained, on surfels that were not fitted to. NaN if too few are seen.

    - `lit`: by a light that changed, as a linear function of the normal, another one in each photo.
    - `mirrored`: by an exposure of each photo and one function of the mirrored direction.
    - `both`: by both together.
    """

    lit: float
    mirrored: float
    both: float

    @property
    def by_changes(self) -> bool:
        """Tell whether a light that changed explains clearly more than mirroring, which then explains hardly any of the rest.

        In a single photo of a mirror, the mirrored direction is a function of the normal, too, so `lit` alone tells nothing.
        """
        return self.lit - self.mirrored > CHANGED and self.both - self.lit < LEFT * (1 - self.lit)

    @property
    def by_mirroring(self) -> bool:
        """Tell whether what is mirrored explains much, and the light did not change."""
        return self.mirrored > NOISE and not self.by_changes

    @property
    def by_none(self) -> bool:
        """Tell whether the changes are noise, which neither explains."""
        return self.both < NOISE


@torch.no_grad()
def explained(observations: Observations, positions: Tensor, radius: float, *parts: Tensor) -> list[Explained]:
    """Explain how parts of a surface change with the view, by a light that changed from photo to photo and by what they mirror.

    Changes and normals are averaged over neighbours. Each of `parts` (N,) is a choice of surfels. `radius` is the scene's.
    """
    near = neighbours(positions, SMOOTHED)
    mean, change, known = averaged(observations, near)
    known &= known.sum(dim=1, keepdim=True) >= LEAST_VIEWS
    relative = (change.mean(dim=2) / mean.mean(dim=1, keepdim=True).clamp_min(1e-2)).clamp(-1, 2)
    smooth = torch.nn.functional.normalize(
        pooled(observations.normal.flatten(1), near).view_as(observations.normal), dim=2
    )
    smoothed = observations._replace(normal=smooth)
    return [_explained(smoothed, relative, known & part[:, None], positions / (CELL * radius)) for part in parts]


def _explained(observations: Observations, relative: Tensor, known: Tensor, cells: Tensor) -> Explained:
    """Explain the changes `relative` (N, V) to the mean radiance, where they are `known` (N, V). One cell of `cells` (N, 3) is 1 wide."""
    chosen = known.any(dim=1).nonzero()[:, 0]
    if len(chosen) < LEAST_SURFELS:
        return Explained(math.nan, math.nan, math.nan)
    chosen = chosen[:: -(-len(chosen) // SURFELS)]
    surfel, photo = known[chosen].nonzero(as_tuple=True)
    at = chosen[surfel]
    weight = observations.pixels[at, photo].double().clamp_min(LEAST_PIXELS)
    normal, towards = observations.normal[at, photo].double(), observations.towards[at, photo].double()
    exposures = torch.nn.functional.one_hot(photo, observations.pixels.shape[1]).double()
    tilts = (exposures[:, :, None] * normal[:, None]).flatten(1)
    lobes = (SHARPNESS * (mirror(-towards, normal) @ torch.from_numpy(sphere(LOBES)).to(weight).T - 1)).exp()
    columns = torch.cat([tilts, exposures, lobes, relative[at, photo].double()[:, None]], dim=1)
    total = columns.new_zeros(len(chosen), columns.shape[1]).index_add_(0, surfel, weight[:, None] * columns)
    weights = weight.new_zeros(len(chosen)).index_add_(0, surfel, weight)
    columns = columns - (total / weights[:, None])[surfel]
    fitted = (cells[at].floor().sum(dim=1) % 2) == 0
    both, target = columns[:, :-1], columns[:, -1]
    models = both[:, : -lobes.shape[1]], both[:, tilts.shape[1] :], both
    before = max(_mean_square(target, weight, ~fitted), 1e-12)
    return Explained(*(max(0.0, 1 - _unexplained(target, model, weight, fitted) / before) for model in models))


def _unexplained(target: Tensor, columns: Tensor, weight: Tensor, fitted: Tensor) -> float:
    """Return the mean square that `columns`, fitted to `target` by ridge regression, leave of it where they are not `fitted`."""
    rows = columns[fitted] * weight[fitted, None]
    square = rows.T @ columns[fitted]
    ridge = RIDGE * square.diagonal().mean().clamp_min(1e-12) * torch.eye(len(square)).to(square)
    return _mean_square(target - columns @ torch.linalg.solve(square + ridge, rows.T @ target[fitted]), weight, ~fitted)


def _mean_square(values: Tensor, weight: Tensor, chosen: Tensor) -> float:
    return float((weight * values.square())[chosen].sum() / weight[chosen].sum().clamp_min(1e-12))
