"""Keep base colours at what photos and experience tell, until the light is learned.

Photos of a mirror do not tell its base colour from the light: twice the light and half of the base colour look the same, and so do a red
light and a bluish base colour. The light is free wherever only one surfel mirrors it, and lamps, which photos clip, are free everywhere.
Surfels learn faster than the light, so errors of the light and shades of the surface ended in base colours. And paint needs light: rather
than few lamps, a thousand dark texels became a little brighter. Six steps prevent that:

- Base colours start at what photos show (`start`), not at grey: else the light takes the object's colour.
- A metal's base colour is drawn to what it shows of the object, divided by what photos show there (`told`). That needs no light. It is one
  colour for a piece (`same_material`).
- Metals keep their mean base colour (`level`).
- What metals mirror of the light is told by them (`told_light`): what lights paint no longer changes it. Only lamps do more for paint.
- The base colour of paint is averaged over neighbours of like colours (`average`), so that the light, not the paint, learns shades. Later,
  only what is finer than shades learns (`keep_shades`).
- Lamps have the colour that highlights of paint tell (`told_hue`). Together with paint they have the brightness that highlights
  (`highlights.py`) and experience tell (`wanted`).

The last three are only done where metals mirror a third of the light: elsewhere it is not known. Metals are drawn and paint is averaged
until 60 % of the training. Later, only their shades and means are kept: photos add patterns and stains.
"""

import math

import numpy as np
import torch
from torch import Tensor

from refgs.capture import LoadedView
from refgs.color import srgb_decode
from refgs.geometry.project import inside, project, sample
from refgs.geometry.visibility import mirror
from refgs.model import cubemap
from refgs.model.environment import CLIPPED, Environment
from refgs.model.surfels import Surfels
from refgs.render.mirrored_light import SIDE
from refgs.spread import spread
from refgs.train.learn import light
from refgs.train.material import same_material
from refgs.train.material.highlights import Told
from refgs.train.material.observe import neighbours
from refgs.train.material.reckoning import METALS, Reckoned, principal_axis
from refgs.train.state import RenderInputs, State

DARKEST, BRIGHTEST = 0.02, 0.98  # base colours
DRAWN = 0.3  # part of the way to the told base colour, each time
LEAST_KNOWN = 0.02  # less spreads from afar
LEAST_PART = 0.05  # fraction of a piece's pixels that must mirror the object to tell its colour; of all metals', to tell anything
BRIGHTNESS = float(torch.tensor(METALS).amax(dim=1).log().mean().exp())  # the brightest channel of most metals
AVERAGED = 64  # neighbours
PASSES = 6  # times that differences are averaged over neighbours, so that shades are left, and no pattern
LIKE = 1.0  # neighbours whose logarithms differ by more have colours of their own
PAINT = 0.34  # all paint's brightest channel in the mean, as far as highlights do not tell, at most: the median of 34 rendered scenes
PAINTS = 0.66  # standard deviation of its natural logarithm in 21 rendered scenes
HUES = 0.13  # standard deviation of the logarithms of a light's hue: Blender's eight HDRIs have this
PARTS_HUES = 0.1  # the same of what highlights show of a light, around the hue of all of it: 18 rendered scenes
LEAST_TOLD = 1 / 3  # fraction of the light's texels that metals must mirror: a flat mirror, seen from above, has 0.4
LEAST_MIRRORED = 2.0  # pixels that must mirror a texel of the coarse cubemap, so that they tell its radiance
STEP, MOST_STEP = 0.3, 0.1  # part of the way to balance, each time, and the largest step: logarithms
TOWARDS = 0.4  # part of the way to what highlights tell, each time that they are compared
FARTHEST = 0.3  # logarithm, from paint's mean to the one that it is drawn to


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

    A metal's reflectance is known where it mirrors the object. What is reflected there, and what a metal of reflectance 1 would reflect,
    spread over the piece. Their ratio is the colour: where normals err, single ratios are too low. If too little of the `metals` (N,)
    mirrors the object, nothing is known. If too little of the piece does, its brightness is drawn to that of most metals, and less is
    known: a bumper seems to mirror the car where it mirrors the street.
    """
    exact, weight = found.seen.exact, (2 * found.metal - 1).clamp_min(0)
    part, pixels = (exact * found.met).sum(dim=1) / exact.sum(dim=1).clamp_min(1e-6), found.pixels * metals
    if (pixels * part).sum() <= LEAST_PART * pixels.sum():
        return torch.zeros(len(metals), 4)
    trust = (same_material.spread(found.graph, part, weight * found.known)[:, None] / LEAST_PART).clamp(0, 1).square()
    values = torch.cat([found.reflected, found.white, torch.ones_like(weight)[:, None]], dim=1)
    *sums, known = (same_material.spread(found.graph, each, weight * found.by_object) for each in values.T)
    reflected, white = torch.stack(sums, dim=1).clamp_min(1e-6).split(3, dim=1)
    color, known = reflected / white, known.clamp(0, 1)[:, None] * trust
    color = color * (BRIGHTNESS / color.amax(dim=1, keepdim=True)) ** (1 - trust)
    return torch.cat([plausible(color), known], dim=1) * (known > LEAST_KNOWN)


def told_light(found: Reckoned, metals: Tensor) -> Tensor | None:
    """Tell which texels (6·SIDE²,) of the light photos show in `metals` (N,). Return None if these are less than LEAST_TOLD.

    A handful of metals must not set the scale of a light that they hardly mirror: all paint would follow it.
    """
    seen, pixels = found.seen, torch.zeros(6 * SIDE**2)
    for view, weight in enumerate(seen.exact.T):
        shows = metals & (weight > 0) & ~found.met[:, view]
        directions = mirror(-seen.towards[shows, view], seen.normal[shows, view])
        pixels.index_add_(0, cubemap.texels_at(directions, SIDE), weight[shows])
    known = pixels > LEAST_MIRRORED
    return known if float(known.float().mean()) >= LEAST_TOLD else None


def told_hue(found: Reckoned, paint: Tensor) -> Tensor:
    """Tell the hue of the light from highlights of `paint` (N,): natural logarithms (3,), whose sum is 0.

    A dielectric's highlight has the light's colour (Shafer 1985), so the radiance of paint changes from photo to photo along that colour.
    The more a surfel changes, the more it counts. The wider the surfels differ, the less their median is trusted against grey. All may
    agree and be wrong: a board mirrors one part of a room.
    """
    axis, change = principal_axis(found.changes)
    weight = found.pixels * paint * found.known * change * (axis > 0).all(dim=1)
    if weight.sum() <= 0:
        return torch.zeros(3)
    logs = axis.clamp_min(1e-3).log()
    logs = logs - logs.mean(dim=1, keepdim=True)
    hue = _median(logs, weight)
    spread = 1.4826 * _median((logs - hue).abs(), weight)  # standard deviation, if the distribution is normal
    hue = hue * HUES**2 / (HUES**2 + PARTS_HUES**2 + spread.square().mean())
    return hue - hue.mean()


def _median(values: Tensor, weight: Tensor) -> Tensor:
    """Return the weighted median of each column of `values` (N, C): (C,)."""
    order = values.argsort(dim=0)
    sums = weight[order].cumsum(dim=0)
    middle = (sums < 0.5 * sums[-1]).sum(dim=0, keepdim=True)
    return values.gather(0, order.gather(0, middle))[0]


@torch.no_grad()
def draw(state: State, metals: Tensor) -> None:
    """Draw base colours of `metals` (N,) to what photos tell."""
    raw = state.learned["albedo"]
    logs, wrong, weight = _wrong(state, metals)
    raw.copy_(torch.where(weight > 0, torch.logit(plausible((logs + DRAWN * weight * wrong).exp())), raw))


@torch.no_grad()
def level(state: State, metals: Tensor) -> None:
    """Keep the mean base colour of `metals` (N,) at what photos tell. Differences between base colours can learn."""
    raw = state.learned["albedo"]
    logs, wrong, weight = _wrong(state, metals)
    off = (weight * wrong).sum(dim=0) / weight.sum().clamp_min(1e-6)
    raw.copy_(torch.where(weight > 0, torch.logit(plausible((logs + off).exp())), raw))


def _wrong(state: State, which: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return logarithms of base colours (N, 3), how far they are from what `which` (N,) keep to, and how much is known of that (N, 1)."""
    color, known = state.learned["shown_color"].split([3, 1], dim=1)
    logs = plausible(state.learned["albedo"].sigmoid()).log()
    return logs, plausible(color).log() - logs, which[:, None] * known


@torch.no_grad()
def average(state: State, paint: Tensor) -> None:
    """Average linear base colours of `paint` (N,) over neighbours of like colours, so that they reflect as much as before.

    This is a bilateral filter (Tomasi and Manduchi 1998): a shade differs little from its neighbours, and a painted pattern much.
    """
    if not paint.any():
        return
    raw, near = state.learned["albedo"], neighbours(state.learned["position"], AVERAGED, paint)
    color = plausible(raw.sigmoid())
    weight = _alike(color.log(), near, paint, state.surfels().opacities)
    raw[paint] = torch.logit(plausible((weight[..., None] * color[near]).sum(dim=1)))


def _alike(logs: Tensor, near: Tensor, which: Tensor, weight: Tensor) -> Tensor:
    """Return the weights (M, K) of the neighbours `near` (M, K) of the surfels `which` (N,). Each row sums to 1.

    The more the logarithms of the colours, `logs` (N, 3), differ, the less a neighbour counts. Only neighbours in `which` count, by their
    `weight` (N,).
    """
    differs = (logs[near] - logs[which, None]).square().sum(dim=2)
    weight = (which * weight)[near] * (-differs / LIKE**2).exp()
    return weight / weight.sum(dim=1, keepdim=True).clamp_min(1e-6)


def spread_alike(values: Tensor, surfels: Surfels, logs: Tensor, which: Tensor, weight: Tensor) -> Tensor:
    """Average `values` (N, C) of surfels in `which` (N,) over PASSES times AVERAGED neighbours with like colours (see `_alike`)."""
    near = neighbours(surfels.positions, AVERAGED, which)
    alike, values = _alike(logs, near, which, weight), values.clone()
    for _ in range(PASSES):
        values[which] = (alike[..., None] * values[near]).sum(dim=1)
    return values


@torch.no_grad()
def keep_shades(state: State, metals: Tensor, paint: Tensor) -> None:
    """Keep shades of base colours: of `metals` (N,) what photos tell, of `paint` (N,) what was learned when this was first done.

    Paint may become darker or brighter as a whole (see `level`). What differs within a few surfels can learn.
    """
    raw, (shown, known) = state.learned["albedo"], state.learned["shown_color"].split([3, 1], dim=1)
    first = paint & (known[:, 0] <= 0)
    shown[first], known[first] = plausible(raw[first].sigmoid()), 1
    which = metals | paint
    logs, wrong, weight = _wrong(state, which)
    kept, surfels = logs + wrong, state.surfels()
    for kind in metals & (known[:, 0] > 0), paint:
        if kind.any():
            wrong = spread_alike(wrong, surfels, kept, kind, surfels.opacities * known[:, 0])
    area = _area(surfels, paint)[:, None]
    wrong[paint] -= (area * wrong).sum(dim=0) / area.sum().clamp_min(1e-30)
    raw[which] = torch.logit(plausible((logs + weight * wrong)[which].exp()))


def _area(surfels: Surfels, which: Tensor) -> Tensor:
    """Return how much surface each surfel of `which` (N,) covers, up to a factor; 0 elsewhere: (N,)."""
    return which * surfels.opacities * surfels.scales.prod(dim=1)


@torch.no_grad()
def wanted(state: State, paint: Tensor, told: Told | None, before: Tensor | None) -> Tensor:
    """Return the mean to which the brightest channel of `paint` (N,) is drawn (see `balance`): a natural logarithm.

    Lamps should be brighter, and so paint darker, if highlights of paint are too dark (`told`, see `highlights.compare`), or if paint is
    brighter than it usually is. Each counts by its variance. `before` is what was returned before. It is changed until highlights agree,
    because photos draw paint elsewhere in between. Highlights do not make paint darker than it usually is: where the model lacks one that
    photos have, no lamp would be bright enough.
    """
    mean = _mean(state, paint)
    change, trust = (math.log(PAINT) - mean).clamp_max(0), PAINTS**-2
    if told is not None:
        change = (trust * change - told.log / told.variance) / (trust + 1 / told.variance)
    before = mean if before is None else before
    new = (before + TOWARDS * change).clamp(mean - FARTHEST, mean + FARTHEST)
    return new.maximum(before.clamp_max(math.log(PAINT)))


def _mean(state: State, paint: Tensor) -> Tensor:
    """Return the logarithm of the mean of the brightest channel of `paint` (N,)."""
    surfels = state.surfels()
    weight = _area(surfels, paint)
    mean = (plausible(surfels.albedo).amax(dim=1) * weight).sum() / weight.sum().clamp_min(1e-30)
    return mean.clamp_min(DARKEST).log()


@torch.no_grad()
def balance(state: State, paint: Tensor, hue: Tensor, mean: Tensor | None) -> None:
    """Change lamps' radiance a little, and base colours of `paint` (N,) so that they make up for it.

    The mean of paint is drawn to `mean`, and the light as a whole to the `hue` (3,), logarithms. The smaller the part of lamps is, the less
    changes.
    """
    radiance, whole, part = _lamps(state)
    change = 0.0 if mean is None else mean - _mean(state, paint)
    change = change + whole.log() - whole.log().mean() - hue
    step = part * (STEP * change).clamp(-MOST_STEP, MOST_STEP)
    raw = state.learned["environment"]
    raw.copy_(torch.where(radiance > CLIPPED, state.method.light.raw(_brighter(radiance, part, -step)), raw))
    raw = state.learned["albedo"]
    color = plausible(raw.sigmoid() * step.exp())
    raw.copy_(torch.where(paint[:, None], torch.logit(color), raw))


@torch.no_grad()
def with_brighter_lamps(state: State, paint: Tensor, change: float) -> RenderInputs:
    """Return what is rendered if `paint` (N,) is darker by `change`, a logarithm, and lamps are brighter, so that it looks the same."""
    inputs = state.inputs()
    radiance, _, part = _lamps(state)
    surfels, light = inputs.surfels, inputs.light
    albedo = torch.where(paint[:, None], math.exp(-change) * surfels.albedo, surfels.albedo)
    light = Environment(_brighter(radiance, part, change), light.reference)
    return inputs._replace(surfels=surfels._replace(albedo=albedo), environment=light)


def _lamps(state: State) -> tuple[Tensor, Tensor, Tensor]:
    """Return the light's radiance (6·R², 3), its power, and the part of lamps, (3,) each."""
    radiance = state.method.light.radiance(state.learned["environment"])
    power = radiance * cubemap.texel_solid_angles(math.isqrt(len(radiance) // 6)).to(radiance).view(-1, 1)
    whole = power.sum(dim=0)
    return radiance, whole, (power * (radiance > CLIPPED)).sum(dim=0) / whole


def _brighter(radiance: Tensor, part: Tensor, change: float | Tensor) -> Tensor:
    """Make lamps brighter, so that the power of all light grows by `change`, a logarithm. Lamps have the `part` (3,) of it."""
    growth = (torch.as_tensor(change).exp() - 1) / part.clamp_min(1e-6)
    return torch.where(radiance > CLIPPED, radiance * (1 + growth), radiance)
