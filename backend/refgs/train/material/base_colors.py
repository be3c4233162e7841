"""Keep base colours at what photos and experience tell, until the light is learned.

Photos of a mirror do not tell its base colour from the light: twice the light and half of the base colour look the same, and so do a red
light and a bluish base colour. The light is free wherever only one surfel mirrors it, and lamps, which photos clip, are free everywhere.
Surfels learn faster than the light, so errors of the light and shades of the surface ended in base colours. Four steps prevent that:

- Base colours start at what photos show (`start`), not at grey: else the light takes the object's colour.
- A metal's base colour is drawn to what it shows of the object, divided by what photos show there (`told`). That needs no light. It is one
  colour for a piece (`same_material`).
- The base colour of paint is averaged over neighbours (`average`), so that the light, not the paint, learns shades.
- Lamps have the colour, and together with paint the brightness, that experience tells (`_balance`).

The last three are done until 60 % of the training, and only where photos tell the base colour of a metal: elsewhere the light is not known.
Later, base colours are free: photos add patterns and stains.
"""

import math

import numpy as np
import torch
from torch import Tensor

from refgs.capture import LoadedView
from refgs.color import srgb_decode
from refgs.geometry.project import inside, project, sample
from refgs.model import cubemap
from refgs.model.environment import Environment
from refgs.spread import spread
from refgs.train.learn import light
from refgs.train.material import same_material
from refgs.train.material.observe import mean_over, neighbours
from refgs.train.material.reckoning import Reckoned
from refgs.train.state import State

DARKEST, BRIGHTEST = 0.02, 0.98  # base colours
DRAWN = 0.3  # part of the way to the told base colour, each time
LEAST_KNOWN = 0.02  # less spreads from afar
LEAST_PART = 0.05  # fraction of the metals' pixels from which on what they mirror of the object tells
AVERAGED = 64  # neighbours
# The most that all paint of a capture has in the mean: the brightest channel, as a logarithm. In 30 rendered scenes, the true means are
# 0.25 times or over 1.9, and photographers expose for 0.18.
PAINT = 0.4
STEP, MOST_STEP = 0.1, 0.05  # part of the way to balance, each time, and the largest step: logarithms


def plausible(color: Tensor) -> Tensor:
    """Clamp base colours, or roughnesses with them, to DARKEST..BRIGHTEST: beyond, a logistic function hardly learns."""
    return color.clamp(DARKEST, BRIGHTEST)


@torch.no_grad()
def start(state: State, positions: np.ndarray, normals: np.ndarray) -> None:
    """Start base colours at the mean radiance that photos show of each surfel, divided by the radiance of the light's start.

    Surfels start at `positions` with `normals` (N, 3). Nothing changes without masks, or if the scene has no linear light.
    """
    environment = state.environment()
    if environment is None or state.method.light.display or "albedo" not in state.learned or not state.from_hull:
        return
    shown = torch.from_numpy(_shown(state.views, positions, normals)).to(state.device)
    color = shown / environment.radiance.mean(dim=0)
    # If channels were clamped alone, colours would lose their hue.
    color = color / (color.amax(dim=1, keepdim=True) / BRIGHTEST).clamp_min(1)
    state.learned["albedo"].copy_(torch.logit(plausible(color)))


def _shown(views: list[LoadedView], positions: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Average the linear radiance (N, 3) of photos at points with `positions` and `normals` (N, 3), over photos that they face."""
    sums = np.zeros((len(positions), 4), np.float32)
    for view in spread(views, light.VIEWS):
        pixels, depth = project(view.camera, positions)
        faces = np.einsum("na,na->n", normals, view.camera.position - positions) > 0
        seen = np.flatnonzero(inside(view.camera, pixels, depth) & faces)
        photo = np.asarray(srgb_decode(view.image.astype(np.float32) / view.white))
        sums[seen, :3] += sample(photo, pixels[seen], clamp=True)
        sums[seen, 3] += 1
    sums += 1e-3 * sums.mean(axis=0) + 1e-9  # the mean of all, for points that no photo faces
    return sums[:, :3] / sums[:, 3:]


def told(found: Reckoned, metals: Tensor) -> Tensor:
    """Return what photos tell of base colours of metal, (N, 4): the linear colour, and how much is known of it, from 0 to 1.

    A metal's reflectance is known where it mirrors the object. It spreads over the piece, as a mean of logarithms. If too little of the
    `metals` (N,) mirrors the object, nothing is known.
    """
    pixels = found.pixels * metals
    if (pixels * found.by_object).sum() <= LEAST_PART * pixels.sum():
        return torch.zeros(len(metals), 4)
    weight = found.by_object * (2 * found.metal - 1).clamp_min(0)
    values = torch.cat([plausible(found.reflectance).log(), torch.ones_like(weight)[:, None]], dim=1)
    *sums, known = (same_material.spread(found.graph, each, weight) for each in values.T)
    color = (torch.stack(sums, dim=1) / known.clamp_min(LEAST_KNOWN)[:, None]).exp()
    return torch.cat([plausible(color), known.clamp(0, 1)[:, None]], dim=1) * (known > LEAST_KNOWN)[:, None]


@torch.no_grad()
def keep(state: State, metals: Tensor, paint: Tensor) -> None:
    """Draw base colours of `metals` (N,) to what photos tell, and balance lamps with `paint` (N,)."""
    raw, (color, known) = state.learned["albedo"], state.learned["shown_color"].split([3, 1], dim=1)
    logs = plausible(raw.sigmoid()).log()
    drawn = DRAWN * known * (plausible(color).log() - logs)
    logs = logs + metals[:, None] * drawn + paint[:, None] * _balance(state, logs, paint)
    raw.copy_(torch.where((metals | paint)[:, None], torch.logit(plausible(logs.exp())), raw))


@torch.no_grad()
def average(state: State, paint: Tensor) -> None:
    """Average linear base colours of `paint` (N,) over neighbours, so that they reflect as much as before."""
    if not paint.any():
        return
    raw, near = state.learned["albedo"], neighbours(state.learned["position"], AVERAGED, paint)
    weight = (paint * state.surfels().opacities)[:, None]
    raw[paint] = torch.logit(plausible(mean_over(near, raw.sigmoid(), weight)))


def _balance(state: State, logs: Tensor, paint: Tensor) -> Tensor:
    """Change lamps' radiance a little, and return the change (3,) of paint's base colours that makes up for it, as a logarithm.

    `logs` (N, 3) are logarithms of base colours. Texels whose radiance exceeds 1 are lamps: photos clip what mirrors them. Photos are
    balanced to white, so the light as a whole is drawn to grey. The smaller the part of lamps is, the less changes.
    """
    radiance = state.method.light.radiance(state.learned["environment"])
    environment = Environment(radiance)
    power = radiance * cubemap.texel_solid_angles(environment.resolution).to(radiance).view(-1, 1)
    whole, lamps = power.sum(dim=0), radiance > 1
    part = (power * lamps).sum(dim=0) / whole
    mean = (logs.amax(dim=1) * paint).sum() / paint.sum().clamp_min(1)
    wanted = (math.log(PAINT) - mean).clamp_max(0) + whole.log() - whole.log().mean()
    step = part * (STEP * wanted).clamp(-MOST_STEP, MOST_STEP)
    brighter = 1 + ((-step).exp() - 1) / part.clamp_min(1e-6)
    raw = state.learned["environment"]
    raw.copy_(torch.where(lamps, state.method.light.raw(radiance * brighter), raw))
    return step
