"""Learn the environment's light, a cubemap: raise its resolution, smooth it by diffusion, and compute its mean radiance.

A term of the loss pulls this mean towards grey, so that the light does not take on the colours of the object.
"""

import math

import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.clock import timed
from refgs.model import cubemap
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.channels import channels
from refgs.render.rasterize import rasterize
from refgs.render.rendering import SOLID
from refgs.render.shade import mirror_directions
from refgs.render.stack import stack
from refgs.render.volume import discs
from refgs.settings import RenderSettings, Settings
from refgs.train.part import Part
from refgs.train.state import State
from refgs.train.timeline import Step

LEAST_SIDE = 16  # texels along a side
DIFFUSED = (
    # Texels along a side for which `environment.diffusion` is given; at other sides, it reaches as far on the sphere.
    64
)
MIRROR_VIEWS = 24  # views that tell which part of the light the object mirrors
MIRROR_SIDE = 16  # texels along a side of the coarse cubemap in which mirrored directions are counted


class MirroredLight(Part):
    """Remember which part of the light the object mirrors towards the cameras: the `weight` of each texel in the light's mean."""

    name, saved = "light", ("weight",)
    weight: Tensor | None = None


def start_value(state: State) -> float:
    """Return the raw value, before activation, at which all texels of the light start."""
    return state.method.light.raw(state.settings.environment.radiance)


def first_resolution(settings: Settings) -> int:
    """Return how many texels the cubemap has along a side at first.

    It is half the final resolution: each texel is then seen more often and learns sooner.
    """
    return max(settings.environment.resolution // 2, LEAST_SIDE)


@torch.no_grad()
def refine(state: State, step: Step) -> None:
    """Double the cubemap's texels along a side, if it has fewer than in the settings."""
    side = math.isqrt(len(state.learned["environment"]) // 6)
    if side >= state.settings.environment.resolution:
        return
    directions = cubemap.texel_directions(2 * side).float()
    finer = cubemap.sample(state.learned["environment"].cpu(), (side,), directions, torch.zeros(len(directions)))
    state.learned.learn("environment", finer.to(state.device), by_row=False)


@torch.no_grad()
def coarsen(state: State, side: int) -> None:
    """Reduce the cubemap to `side` texels along a side by averaging texels."""
    fine = math.isqrt(len(state.learned["environment"]) // 6) // side
    texels = state.learned["environment"].view(6, side, fine, side, fine, 3).mean(dim=(2, 4)).reshape(-1, 3)
    state.learned.learn("environment", texels, by_row=False)


@timed("optimiser")
@torch.no_grad()
def diffuse(state: State, step: Step) -> None:
    """Smooth the light a little: blend each texel with its neighbours on the cubemap face, and fade it towards grey.

    Both effects are proportional to the light's learning rate. They are a step apart from the optimiser's, like decoupled weight decay
    (Loshchilov and Hutter 2019). Where the photos agree on a texel, the optimiser moves it faster than this step, and details and colours
    stay. Where only noise moves the texels, they become alike and grey. The mean over all texels and channels does not change.
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
    """Average the light's radiance (3,) over the pixels in which cameras see it mirrored. All these pixels count equally.

    Returns None if the scene has no light, or if no term of the loss uses this mean.
    """
    if light is None or state.settings.loss.light == 0:
        return None
    mirrors = state.part(MirroredLight)
    if mirrors.weight is None or len(mirrors.weight) != len(light.radiance):
        cameras = state.spread_cameras(MIRROR_VIEWS)
        with torch.no_grad():
            mirrors.weight = mirrored(state.surfels(), cameras, light, state.settings.render, state.near)
    return mirrors.weight @ light.radiance


def mirrored(
    surfels: Surfels, cameras: list[Camera], light: Environment, settings: RenderSettings, near: float
) -> Tensor:
    """Return a weight for each texel of the light (6·R²,), where R is the cubemap's side. The weights sum to one.

    The weight is proportional to the number of pixels in which the cameras see the texel's surroundings mirrored in the object. Without it,
    directions that only a few pixels mirror could take any colour to make the mean grey. If no texel is mirrored, all texels are weighted
    by their solid angles. Surfels nearer to a camera than `near` are not drawn.
    """
    pixels = torch.zeros(6 * MIRROR_SIDE * MIRROR_SIDE)
    settings = settings.model_copy(update={"reflection": "microfacet"})  # treat matte surfaces as reflective here
    for camera in cameras:
        lit = stack(channels(surfels, camera, settings, indirect=True))
        features, _, alpha = rasterize(*discs(surfels, camera), lit, camera, near=near)
        turn = torch.from_numpy(light.turn(camera)).float().T
        mirrored = _texels_at(mirror_directions(features, alpha, camera)[alpha > SOLID].cpu() @ turn)
        pixels += torch.bincount(mirrored, minlength=len(pixels))
    part = _texels_at(cubemap.texel_directions(light.resolution).float())
    weights = (pixels / torch.bincount(part, minlength=len(pixels)).clamp_min(1))[part]
    if not pixels.any():
        weights = cubemap.texel_solid_angles(light.resolution).float()
    return (weights / weights.sum()).to(light.radiance.device)


def _texels_at(directions: Tensor) -> Tensor:
    """Return the indices of the texels that lie in the directions (P, 3), on a coarse cubemap with MIRROR_SIDE texels along a side."""
    face, s, t = cubemap.face_coordinates(directions)
    column, row = (((x + 1) / 2 * MIRROR_SIDE).long().clamp(0, MIRROR_SIDE - 1) for x in (s, t))
    return (face * MIRROR_SIDE + row) * MIRROR_SIDE + column
