"""Learn the environment's light, a cubemap: raise its resolution, smooth it by diffusion, and compute its mean radiance.

A term of the loss pulls this mean towards grey, so that the light does not take on the colours of the object.
"""

import math

import torch
from torch import Tensor

from refgs.clock import timed
from refgs.model import cubemap
from refgs.model.environment import Environment
from refgs.render.mirrored_light import mirrored_light
from refgs.settings import Settings
from refgs.spread import spread
from refgs.train.part import Part
from refgs.train.state import State
from refgs.train.timeline import Step

LEAST_SIDE = 16  # texels along a side
DIFFUSED = 64  # texels along a side for which `environment.diffusion` is given; with others, it reaches as far
MEAN = 1 / 3  # base colour of things on average
DARK = 1e-3  # radiance; the light never starts darker, though photos may be black
VIEWS = 24  # views that are looked at, at most: how bright the object is, and which part of the light it mirrors


class MirroredLight(Part):
    """Hold `weight` (6·R²,), larger where more pixels mirror the texel, with a sum of 1."""

    name, saved = "light", ("weight",)
    weight: Tensor | None = None


def start_value(state: State) -> Tensor:
    """Return the value, before activation, at which the light's texels start: a scalar on the training's device.

    Under a light that starts brighter than the photos, what little a metal mirrors in a dark room is learned as a dark base colour. Photos
    never correct that: they do not tell the scale of one from that of the other. So linear light starts at most so bright that it lights
    a surface of the base colour MEAN like the mean of the photos.
    """
    light, radiance = state.method.light, state.settings.environment.radiance
    if light.display:
        return light.raw(torch.tensor(radiance, dtype=torch.double, device=state.device))
    return light.raw((_shown(state) / MEAN).clamp(DARK, radiance))


def _shown(state: State) -> Tensor:
    """Return the object's mean radiance in some training photos, a scalar; of photos without masks, that of all pixels."""
    sums = []
    for photo in spread(state.photos, VIEWS):
        linear = photo.linear
        pixels = torch.ones_like(linear[..., 0]) if photo.mask is None else photo.mask.float() / 255
        sums.append(torch.stack([linear.mean(dim=-1).sum(), pixels.sum()]).double())
    shown, pixels = torch.stack(sums).sum(dim=0)
    return shown / pixels.clamp_min(1e-6)


def first_resolution(settings: Settings) -> int:
    """Return how many texels the light's cubemap has along a side at first: half the final number, but at least LEAST_SIDE.

    With fewer texels, each one is seen more often and learns sooner.
    """
    return max(settings.environment.resolution // 2, LEAST_SIDE)


@torch.no_grad()
def refine(state: State, step: Step) -> None:
    """Double the resolution of the light's cubemap, up to `environment.resolution`."""
    side = math.isqrt(len(state.learned["environment"]) // 6)
    if side >= state.settings.environment.resolution:
        return
    directions = cubemap.texel_directions(2 * side).float()
    finer = cubemap.sample(state.learned["environment"].cpu(), (side,), directions, torch.zeros(len(directions)))
    state.learned.learn("environment", finer.to(state.device), by_row=False)


@torch.no_grad()
def coarsen(state: State, side: int) -> None:
    """Reduce the light's cubemap to `side` texels along a side by averaging texels."""
    state.learned.learn("environment", cubemap.reduced(state.learned["environment"], side), by_row=False)


@timed("optimiser")
@torch.no_grad()
def diffuse(state: State, step: Step) -> None:
    """Smooth the light a little: blend each texel with its neighbours on the cubemap face, and fade it towards grey.

    Both effects are proportional to the light's learning rate. They are separate from the optimiser's step, like decoupled weight decay
    (Loshchilov and Hutter 2019). Where the photos agree on a texel, the optimiser is stronger than this step: details and colours stay.
    Where only noise moves the texels, they become alike and grey. The mean of the texels' logarithms does not change.
    """
    side = math.isqrt(len(state.learned["environment"]) // 6)
    rate, settings = state.learned.rates["environment"], state.settings.environment
    if grey := min(rate * settings.grey, 1.0):
        state.learned["environment"].lerp_(state.learned["environment"].mean(dim=1, keepdim=True), grey)
    part = min(rate * settings.diffusion * (side / DIFFUSED) ** 2, 0.25)
    if part == 0:
        return
    texels = state.learned["environment"].view(6, side, side, 3)
    for axis in (1, 2):
        flow = part * texels.diff(dim=axis)
        texels.narrow(axis, 0, side - 1).add_(flow)
        texels.narrow(axis, 1, side - 1).sub_(flow)


def mean_radiance(state: State, light: Environment | None) -> Tensor | None:
    """Average the light's radiance (3,) over all pixels in which the object mirrors it to a camera. These pixels count equally.

    Returns None if the scene has no light, or if no term of the loss uses this mean.
    """
    if light is None or state.settings.loss.light == 0:
        return None
    mirrors = state.part(MirroredLight)
    if mirrors.weight is None or len(mirrors.weight) != len(light.radiance):
        cameras = state.spread_cameras(VIEWS)
        with torch.no_grad():
            mirrors.weight = mirrored_light(state.surfels(), cameras, light, state.settings.render, state.near)
    return mirrors.weight @ light.radiance
