"""Tell mirroring surfaces from matte surfaces whose light changes from photo to photo.

The light can change because of clouds, a lamp that is carried along, or the photographer's shadow. Then the radiance of a matte surface
changes in the surface's own colour. The radiance of a coloured metal changes like this, too, when the view changes.

Two models are fitted to tell these apart. In the first, the light changes: in each photo, the change is nearly linear in the surface normal
(Ramamoorthi and Hanrahan 2001), with other coefficients in each photo. In the second, the surface mirrors: the change is one function of
the mirror direction, the same in all photos.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from refgs.geometry.visibility import mirror
from refgs.render.relight import sphere
from refgs.train.material.observe import LEAST_PIXELS, LEAST_VIEWS, Observations, averaged, observe_changes, pooled
from refgs.train.part import Part
from refgs.train.state import State

SURFELS = 3000  # surfels that are looked at, at most
LEAST_SURFELS = 400  # fewer surfels tell nothing
SMOOTHED = 32  # neighbours whose normals are averaged: those of single surfels are rough early in the training
LOBES, SHARPNESS = 50, 10.0  # lobes of the mirrored direction, 0.3 radians wide: they cover the sphere
RIDGE = 1e-3  # ridge, as a fraction of the columns' mean square
MOST = 0.4  # fraction of the variance; a larger lead tells no more
CELL = 0.15  # side of a grid's cells, in scene radii: models are fitted to half of the cells, tested on the others


class Explained(NamedTuple):
    """Hold which fraction (0..1) of the variance of a surface's changes each model explains, measured on surfels left out of the fit.

    - `lit`: the light changes. This model is a linear function of the normal for each photo.
    - `mirrored`: the surface mirrors. This model is one function of the mirror direction, and an exposure for each photo.
    - `both`: the sum of these two models.
    - `error`: the standard error of `lit` − `mirrored`, by the jackknife over the grid's cells (Efron and Stein 1981).

    All are NaN if too few surfels are seen.
    """

    lit: float
    mirrored: float
    both: float
    error: float


class ChangingLight(Part):
    """Remember by how much a changing light explains more than mirroring, see `lead`. It is None before it was measured."""

    name, saved = "changing light", ("lead",)
    lead: Tensor | None = None

    def start(self, state: State) -> None:
        self.lead = None


@torch.no_grad()
def lead(state: State, near: Tensor) -> float:
    """Measure by how much more of the variance a changing light explains than mirroring, 0 to MOST: one number for the whole object.

    It is less by its standard error: gold about which both models say the same was taken for paint by half.
    It is measured once: surfels learn some of what changes as their shape, so that a later figure tells less. `near` (N, K) are the nearest
    surfels, themselves first.
    """
    part = state.part(ChangingLight)
    if part.lead is None:
        points = state.learned["position"].detach()
        found = explained(observe_changes(state), points, near.to(state.device), state.capture.radius)
        more = found.lit - found.mirrored - found.error
        part.lead = torch.tensor(0.0 if math.isnan(more) else min(max(more, 0.0), MOST))
    return float(part.lead)


@torch.no_grad()
def explained(observations: Observations, positions: Tensor, near: Tensor, radius: float) -> Explained:
    """Measure how well two models explain the surface's changes from photo to photo: a changing light, and mirroring.

    Changes and normals are averaged over neighbours. `near` (N, K) are the nearest surfels, themselves first. `radius` is that of the
    scene, in world units.
    """
    near = near[:, :SMOOTHED]
    mean, change, known = averaged(observations, near)
    known &= known.sum(dim=1, keepdim=True) >= LEAST_VIEWS
    relative = (change.mean(dim=2) / mean.mean(dim=1, keepdim=True).clamp_min(1e-2)).clamp(-1, 2)
    smooth = torch.nn.functional.normalize(pooled(observations.normal, near), dim=2)
    smoothed = observations._replace(normal=smooth)
    return _explained(smoothed, relative, known, positions / (CELL * radius))


def _explained(observations: Observations, relative: Tensor, known: Tensor, cells: Tensor) -> Explained:
    """Fit the models to the changes `relative` (N, V) where they are `known` (N, V), and measure what they explain.

    Changes are divided by the surfel's mean radiance. `cells` (N, 3) are positions in units of a grid's cells. The models are fitted in
    every second cell, and measured in the others.
    """
    chosen = known.any(dim=1).nonzero()[:, 0]
    if len(chosen) < LEAST_SURFELS:
        return Explained(math.nan, math.nan, math.nan, math.nan)
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
    cell = cells[at].floor()
    fitted = (cell.sum(dim=1) % 2) == 0
    both, target = columns[:, :-1], columns[:, -1]
    models = both[:, : -lobes.shape[1]], both[:, tilts.shape[1] :], both
    squares = [target.square(), *(_residual(target, model, weight, fitted).square() for model in models)]
    # Sums over each cell, of those left out of the fit.
    cell, number = torch.unique(cell[~fitted], dim=0, return_inverse=True)
    squares = (weight[:, None] * torch.stack(squares, dim=1))[~fitted]
    sums = squares.new_zeros(len(cell), len(squares.T)).index_add_(0, number, squares)
    whole = sums.sum(dim=0)
    lit, mirrored, together = (1 - whole[1:] / whole[0].clamp_min(1e-12)).clamp_min(0).tolist()
    without = whole - sums
    leads = (without[:, 2] - without[:, 1]) / without[:, 0].clamp_min(1e-12)
    error = ((len(cell) - 1) * leads.var(correction=0)).sqrt()
    return Explained(lit, mirrored, together, float(error))


def _residual(target: Tensor, columns: Tensor, weight: Tensor, fitted: Tensor) -> Tensor:
    """Fit `columns` (P, K) to `target` (P,) where `fitted`; return what is left of all of it (P,)."""
    rows = columns[fitted] * weight[fitted, None]
    square = rows.T @ columns[fitted]
    ridge = RIDGE * square.diagonal().mean().clamp_min(1e-12) * torch.eye(len(square)).to(square)
    return target - columns @ torch.linalg.solve(square + ridge, rows.T @ target[fitted])
