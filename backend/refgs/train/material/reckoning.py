"""Reckon how likely each surfel is metal: one sum of evidence, in log-odds.

Each test of the photos is a term, a number for each surfel and its neighbours. The log-odds of metal against paint are a weighted sum of
terms (a logistic regression), spread over the piece of surface that a surfel belongs to (`same_material`). The weights were fitted to still
lifes of random shapes, materials and lights, other scenes, and real captures; docs/notebook/scenes.md names them.
"""

import math
from typing import NamedTuple

import torch
from scipy import sparse
from torch import Tensor

from refgs.model.surfels import Surfels
from refgs.train.learn import trace
from refgs.train.material import changing_light, mirrored, same_material
from refgs.train.material.observe import (
    COLOURED,
    LEAST_PIXELS,
    NEIGHBOURS,
    Seen,
    from_grey,
    neighbours,
    pooled,
)
from refgs.train.state import State, why_not_traced

WEIGHTS = {
    "fall": 5.58,
    "light's fall": -0.77,
    "ratio": 2.77,
    "reflectance": 4.62,
    "object's ratio": 2.95,
    "object's reflectance": 6.02,
    "tint": 1.86,
    "grey": 2.25,
    "no metal's colour": -2.12,
    "no metal's colour, by the object": -2.65,
    "too dark for metal": -2.89,
    "changing light": -24.87,
}
BIAS = -4.26
LOW = 0.1  # quantile over the photos
DARKEST = 1e-4  # radiance: photos tell no darker ones apart
# Terms that are larger tell no more. The darkest metal, titanium, is 0.8 dark.
MOST_FALL, MOST_RATIO, MOST_DARK = 2.5, 1.5, 1.0
ENOUGH_PIXELS = 30.0  # the neighbours' pixels in all photos from which on what they mirror of the object tells
LEAST_SHOWN = 0.02  # least mean radiance of what a surfel mirrors of the object: in less, errors tell more
CHANGES = 0.15  # relative change from which on its colour tells fully
# Linear F0 of chromium, brass, gold and copper (https://physicallybased.info): corners of a polygon of chromaticities, in which those of
# silver, aluminium, titanium, iron and bronze lie.
METALS = (0.654, 0.685, 0.701), (0.910, 0.778, 0.423), (1.059, 0.773, 0.307), (0.932, 0.623, 0.522)
FOREIGN = 0.05  # distance of a chromaticity from those of metals; farther ones tell no more. A metal's is wrong by 0.02 where normals err
LIKE = 0.01  # weight of a metal's material if it is only fitted, relative to a learned one


class Reckoned(NamedTuple):
    """Hold the probability (N,) that each of N surfels is metal, and what it was reckoned from. All tensors are on the CPU.

    - `metal`: the probability; 1/2 where no photo tells
    - `pixels` (N,): how much each surfel counts for shares of the surface: its pixels in these photos, 0 beyond the region to train
    - `reflectance` (N, 3), `roughness` (N,): values of the metal that explains the photos best
    - `by_object` (N,): whether the reflectance follows from what photos show of the object, so that it does not depend on the light
    - `reflected`, `white` (N, 3): see `mirrored.Fit`, by the photos in which surfels mirror the object
    - `met` (N, V): whether a surfel mirrors the object in a photo that shows it
    - `changes` (N, 3, 3): the covariance of the radiance of a surfel and its neighbours over the photos, relative to its mean
    - `graph`: the Laplacian of neighbouring surfels (`same_material.laplacian`)
    - `terms`: see WEIGHTS, (N,) each, before they are spread
    - `known` (N,): whether photos show the surfel and its neighbours well enough for terms
    """

    metal: Tensor
    surfels: Surfels
    seen: Seen
    pixels: Tensor
    reflectance: Tensor
    roughness: Tensor
    by_object: Tensor
    reflected: Tensor
    white: Tensor
    met: Tensor
    changes: Tensor
    graph: sparse.csr_matrix
    terms: dict[str, Tensor]
    known: Tensor

    @property
    def shown(self) -> Tensor:
        """Tell which surfels (N,) enough pixels show to be reckoned."""
        return self.seen.pixels > same_material.FRINGE


@torch.no_grad()
def reckon(state: State) -> Reckoned:
    """Look at the photos, and reckon from them how likely each surfel is metal. What the training has learned so far does not count."""
    occluder = state.occluder
    if occluder is None and not why_not_traced(state):
        occluder = trace.mesh_of(state, state.inputs().surfels.chosen(state.wanted()))
    surfels, seen, rays = mirrored.observe_both(state, occluder)
    near = neighbours(surfels.positions, NEIGHBOURS)
    fits = mirrored.fit_both(seen, rays, near)
    graph = same_material.laplacian(surfels.positions, seen, near)
    shown, changes = mean_and_changes(seen, near)
    every, of_object = fits.everywhere, fits.of_object
    level, by_object = told_by_object(of_object)
    reflectance = torch.where(by_object[:, None], level.clamp_max(1), every.reflectance)
    values = terms(seen, fits, near, level, by_object, shown, changes)
    values["changing light"] = torch.full_like(seen.pixels, changing_light.lead(state, near))
    known = (seen.pixels > same_material.FRINGE) & (every.pixels > ENOUGH_PIXELS) & (every.exact > LEAST_PIXELS)
    metal = same_material.spread(graph, log_odds(values), known.float()).sigmoid()
    roughness = torch.where(by_object, of_object.roughness, every.roughness)
    pixels = seen.pixels * state.wanted().cpu()
    sums = of_object.reflected, of_object.white, fits.met
    return Reckoned(
        metal, surfels, seen, pixels, reflectance, roughness, by_object, *sums, changes, graph, values, known
    )


def told_by_object(of_object: mirrored.Fit) -> tuple[Tensor, Tensor]:
    """Return the reflectance (N, 3) of a metal that shows what a surfel does of the object, and whether photos tell it (N,).

    It does not depend on the light. It is above 1 where a surfel is brighter than what it mirrors.
    """
    known = (of_object.exact > ENOUGH_PIXELS) & (of_object.white.mean(dim=1) > LEAST_SHOWN * of_object.exact)
    return (of_object.reflected / of_object.white.clamp_min(1e-6)).clamp_min(0), known


def log_odds(values: dict[str, Tensor]) -> Tensor:
    """Weigh the terms (N,) by their names, and return their sum (N,): the log-odds of metal against paint."""
    return BIAS + torch.stack([weight * values[name] for name, weight in WEIGHTS.items()]).sum(dim=0)


def terms(
    seen: Seen,
    fits: mirrored.Mirrored,
    near: Tensor,
    level: Tensor,
    by_object: Tensor,
    shown: Tensor,
    changes: Tensor,
) -> dict[str, Tensor]:
    """Compute the terms (N,) that compare what each surfel shows with what it mirrors.

    `near` (N, K) are neighbours to average over; `shown` and `changes` is what they show (`mean_and_changes`). `level` (N, 3) is what the
    object tells of the reflectance of a metal, and `by_object` (N,) where it does (`told_by_object`).

    - fall: how far the darkest tenth of the photos is below the median, as a logarithm. A metal has no diffuse radiance, so it may be far
      darker than its median. Clipped photos count: what is brighter than the median does not change it.
    - light's fall: the same of what the surfel mirrors. A metal falls only where that falls.
    - ratio, reflectance: see `mirrored.Fit`, by the light and, as "object's …", by photos in which the surfel mirrors the object
    - tint: whether the radiance changes along the surface's own colour (1), as a coloured metal's, or along grey (0)
    - grey: 1 where the surface has no colour, so that its tint tells nothing
    - no metal's colour: how far the reflectance is from that of all metals, from 0 to 1 (`from_metals`), by the light and by the object
    - too dark for metal: how far `level` is below 1 in its brightest channel, as a logarithm from 0 to MOST_DARK

    One more, "changing light", is a number for the whole object (`changing_light.lead`).
    """
    every, of_object = fits.everywhere, fits.of_object
    met = of_object.pixels > ENOUGH_PIXELS
    tint, grey = _tint(shown, changes)
    return {
        "fall": _fall(seen.radiance.mean(dim=2), seen, near),
        "light's fall": _fall(fits.radiance, seen, near),
        "ratio": (-every.ratio).clamp(-MOST_RATIO, MOST_RATIO),
        "reflectance": every.reflectance.amax(dim=1),
        "object's ratio": met * (-of_object.ratio).clamp(-MOST_RATIO, MOST_RATIO),
        "object's reflectance": met * of_object.reflectance.amax(dim=1),
        "tint": tint,
        "grey": grey,
        "no metal's colour": from_metals(every.reflectance) / FOREIGN,
        "no metal's colour, by the object": by_object * from_metals(level) / FOREIGN,
        "too dark for metal": by_object * (-level.amax(dim=1).log()).clamp(0, MOST_DARK),
    }


def from_metals(color: Tensor) -> Tensor:
    """Return how far the chromaticities of linear colours (N, 3) are from those of metals: (N,), from 0 to FOREIGN.

    All metals reflect colours between a bluish grey, yellow and orange. Red, green and blue things are paint, and so is bright yellow
    plastic, which reflects less blue than gold.
    """
    corners = from_grey(torch.tensor(METALS))
    # Chromaticities lie in a plane across grey, in which this is normal to the polygon's sides.
    outward = torch.linalg.cross(corners.roll(-1, dims=0) - corners, torch.ones_like(corners))
    outward = -torch.nn.functional.normalize(outward, dim=1)
    point = from_grey(color.clamp_min(0))
    return ((point[:, None] - corners) * outward).sum(dim=2).amax(dim=1).clamp(0, FOREIGN)


def _fall(radiance: Tensor, seen: Seen, near: Tensor) -> Tensor:
    """Compute how far below its median each surfel's `radiance` (N, V) falls in a tenth of the photos: a logarithm (N,), at least 0."""
    radiance = radiance.masked_fill(seen.weight <= 0, math.nan)  # NaN: a photo that does not show it
    levels = radiance.nanquantile(radiance.new_tensor([LOW, 0.5]), dim=1).nan_to_num().T
    pixels = seen.pixels[:, None]
    low, median, total = pooled(torch.cat([levels * pixels, pixels], dim=1), near).unbind(dim=1)
    low, median = (level / total.clamp_min(1e-6) for level in (low, median))
    return (median.clamp_min(DARKEST) / low.clamp_min(DARKEST)).log().clamp(0, MOST_FALL)


def mean_and_changes(seen: Seen, near: Tensor) -> tuple[Tensor, Tensor]:
    """Average what surfels and their neighbours show over the photos: the mean radiance (N, 3), and its covariance (N, 3, 3).

    The covariance is that of the radiance divided by the brightness of its mean.
    """
    exact = seen.exact  # clipped highlights look too white
    pixels = pooled(exact, near)
    shown = pooled(seen.radiance * exact[..., None], near)
    known = (pixels > LEAST_PIXELS)[..., None]
    count = known.sum(dim=1).clamp_min(1)
    shown = shown / pixels.clamp_min(1e-6)[..., None] * known
    mean = shown.sum(dim=1) / count
    change = (shown - mean[:, None]) * known / mean.mean(dim=1).clamp_min(1e-2)[:, None, None]
    return mean, change.transpose(1, 2) @ change / count[:, None]


def principal_axis(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Return the unit axes (N, 3) along which colours change most, brighter in the sum, and their variances (N,) there.

    `covariance` (N, 3, 3) is that of linear colours.
    """
    values, vectors = torch.linalg.eigh(covariance)
    axis = vectors[:, :, 2]
    return axis * torch.sign(axis.sum(dim=1, keepdim=True)), values[:, 2]


def _tint(mean: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Compute how much the radiance of surfels and their neighbours changes along their own colour, and which have none: (N,) each.

    A dielectric's reflection has the light's colour, which is grey on average. The direction of change is the first principal axis of the
    radiance over the photos. See `mean_and_changes` for `mean` (N, 3) and `covariance` (N, 3, 3).
    """
    axis = principal_axis(covariance)[0]
    axis = axis / axis.sum(dim=1, keepdim=True).clamp_min(0.2)
    own = from_grey(mean)
    colour = own.norm(dim=1)
    along = ((axis - 1 / 3) * own).sum(dim=1) / colour.square().clamp_min(1e-6)
    size = covariance.diagonal(dim1=1, dim2=2).mean(dim=1).sqrt()
    coloured = (colour > COLOURED).float()
    return coloured * along.clamp(-0.5, 1.5) * (size / CHANGES).clamp(0, 1), 1 - coloured


def like_metals(found: Reckoned) -> Tensor:
    """Return base colour and roughness of the metals to which each surfel is connected, (N, 4)."""
    surfels = found.surfels
    learned, fitted = (
        torch.cat([colour, rough[:, None]], dim=1)
        for colour, rough in ((surfels.albedo, surfels.roughness), (found.reflectance, found.roughness))
    )
    # Surfels that were paint so far have learned the colour of what they mirror, so their fitted material is used. Metals have learned a
    # wrong base colour where the light is wrong, but what they show of the object tells the right one.
    known = (surfels.metallic > 0.5) & ~found.by_object
    material = torch.where(known[:, None], learned, fitted)
    weight = (2 * found.metal - 1).clamp_min(0) * torch.where(known | found.by_object, 1.0, LIKE)
    return torch.stack([same_material.spread(found.graph, each, weight) for each in material.T], dim=1)
