"""Estimate the light anew from what metals show of it, where the light learned so far explains the photos worse.

In a dark room, training blurs the light: its dark parts stay too bright and its lamps too dim, while metals grow rough and dark to make up
for it. Once photos tell what is metal (`mirrored`), and how much it reflects, each of their pixels shows a piece of the light. Lamps are
clipped there, so that only their outlines are shown. Their radiance follows from what paint receives from them.
"""

import math

import numpy as np
import torch
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs
from torch import Tensor

from refgs.model import cubemap
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.train import probe
from refgs.train.material.mirrored import mirror_rays
from refgs.train.material.observe import OBSERVED_VIEWS, Seen
from refgs.train.state import RenderInputs, State

NEAR = 6  # texels over which a surfel's radiance is spread
SPREAD = 0.7  # texels, standard deviation of this
LOW = 0.25  # quantile of what metals show of a texel
LEAST = 0.5  # sum of weights from which on a texel is known
DARKEST = 1e-3  # radiance; photos tell no darker ones apart
PAINT = 0.4  # base colour that paint has in the median: half of paints are within a factor of two
BRIGHTEST = 1e4  # times white, of lamps


@torch.no_grad()
def shown_light(state: State, surfels: Surfels, seen: Seen, metal: Tensor, reflectance: Tensor) -> Tensor | None:
    """Estimate the light's radiance (6·R², 3) from what the surfels in the mask `metal` (N,) mirror of it. All arguments are on the CPU.

    `reflectance` (N, 3) are their base colours. Returns None if they show too little of it.
    """
    side = math.isqrt(len(state.learned["environment"]) // 6)
    directions = cubemap.texel_directions(side).float()
    texels, turns = cKDTree(directions.numpy()), state.inputs().light.turn
    total, burnt = torch.zeros(2, len(directions))
    rows = []
    views = probe.spread_views(state, OBSERVED_VIEWS)
    for number, (view, rays) in enumerate(zip(views, mirror_rays(state, surfels, seen), strict=True)):
        free = metal & ((seen.weight[:, number] > 0) | (seen.burnt[:, number] > 0)) & torch.from_numpy(rays.face < 0)
        turn = torch.from_numpy(turns(state.photo(view).camera)).float()
        distance, at = texels.query((rays.direction @ turn.T)[free].numpy(), k=np.arange(1, NEAR + 1))
        near = torch.from_numpy(np.exp(-0.5 * (distance / (SPREAD * math.pi / 2 / side)) ** 2)).float()
        whole, clipped = near * seen.weight[free, number, None], near * seen.burnt[free, number, None]
        shown = seen.radiance[free, number] / reflectance[free].clamp_min(0.04)
        for texel, share, lost in zip(torch.from_numpy(at).T, whole.T, clipped.T, strict=True):
            total.index_add_(0, texel, share)
            burnt.index_add_(0, texel, lost)
            rows.append((texel, share, shown))
    known = total > LEAST
    if not known.any():
        return None
    nearest = torch.from_numpy(cKDTree(directions[known].numpy()).query(directions.numpy())[1])
    texel, weight, shown = (torch.cat(each) for each in zip(*rows, strict=True))
    room = _low(texel, weight, shown, total)[known][nearest]
    lamp = _outlines((burnt / (total + burnt))[known][nearest], cubemap.texel_solid_angles(side).float())[:, None]
    dim, lamp = (1 - lamp) * room.clamp_min(DARKEST), lamp.expand(-1, 3)
    return dim + _scale(surfels, seen, metal, dim, lamp) * lamp


def _low(texel: Tensor, weight: Tensor, shown: Tensor, total: Tensor) -> Tensor:
    """Return, for each texel, the quantile LOW of what is shown of it (T, 3), by the mean of the channels.

    What a surfel shows is what it mirrors and, where its shape is wrong, light from elsewhere. So the darker ones are nearer to the truth.
    `texel`, `weight` (S,) and `shown` (S, 3) are samples. `total` (T,) are the sums of the weights.
    """
    order = shown.mean(dim=1).argsort()
    order = order[texel[order].argsort(stable=True)]
    texel, weight = texel[order], weight[order].double()
    before = total.double().cumsum(0) - total
    reached = weight.cumsum(0) - before[texel] >= LOW * total[texel]
    found = torch.zeros(len(total), 3)
    first = reached & ~torch.cat([reached.new_zeros(1), reached[:-1] & (texel[1:] == texel[:-1])])
    found[texel[first]] = shown[order][first]
    return found


def _outlines(share: Tensor, area: Tensor) -> Tensor:
    """Return which texels show lamps (T,), 0 or 1: those with the largest `share` of clipped pixels, in all as large as the sum of shares.

    Wrong normals blur the outlines of lamps, but do not change their area.
    """
    order = share.argsort(descending=True)
    lamp = torch.zeros_like(share)
    lamp[order] = (area[order].cumsum(0) <= (share * area).sum()).to(share)
    return lamp


def _scale(surfels: Surfels, seen: Seen, metal: Tensor, dim: Tensor, lamp: Tensor) -> float:
    """Return the radiance of lamps with which paint has a base colour of PAINT in the median, at least 1 (white).

    `dim` (6·R², 3) is the light without lamps. `lamp` is the same with lamps alone, of radiance 1.
    """
    paint = ~metal & (surfels.metallic < 0.5) & (seen.pixels > 0)
    if not paint.any():
        return 1.0
    received, more = (
        surfels.received[paint] * Environment(light).diffuse(seen.outward[paint]) for light in (dim, lamp)
    )
    # The radiance of lamps with which a surfel's base colour is PAINT. Those on which lamps shine most count most.
    more = more.mean(dim=1).clamp_min(1e-6)
    needed = (seen.mean[paint] / PAINT - received).mean(dim=1) / more
    order = needed.argsort()
    reached = (seen.pixels[paint] * more)[order].cumsum(0)
    median = float(needed[order][torch.searchsorted(reached, reached[-1] / 2)])
    return min(max(median, 1.0), BRIGHTEST)


def paint_under(radiance: Tensor, surfels: Surfels, seen: Seen) -> Tensor:
    """Return the base colours (N, 3) with which paint shows the mean radiance that photos show, under a light (6·R², 3)."""
    received = surfels.received * Environment(radiance).diffuse(seen.outward)
    return (seen.mean / received.clamp_min(1e-6)).clamp(0, 1)


@torch.no_grad()
def error(state: State, inputs: RenderInputs) -> float:
    """Measure the mean squared error of some training views' pictures, over the object's pixels."""
    total, pixels = 0.0, 0
    for view in probe.spread_views(state):
        shown = probe.on_object(state, inputs.surfels, view)
        off = probe.picture(state, view, inputs).color.clamp(0, 1) - state.photo(view).over(state.background)
        total += float(off[shown].square().sum())
        pixels += int(shown.sum())
    return total / max(pixels, 1)
