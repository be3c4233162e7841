"""Find out which part of the light the cameras see mirrored in the object."""

import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.model import cubemap
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.channels import channels
from refgs.render.rasterize import rasterize
from refgs.render.rendering import SOLID
from refgs.render.shade import mirror_directions
from refgs.render.stack import stack
from refgs.render.volume import discs
from refgs.settings import RenderSettings

SIDE = 16  # texels along a side of the coarse cubemap in which mirrored directions are counted
PIXELS = 128  # pixels of a picture's longer side, at most: more count the same directions


def mirrored_light(
    surfels: Surfels, cameras: list[Camera], light: Environment, settings: RenderSettings, near: float
) -> Tensor:
    """Return a weight for each texel of the light (6·R²,), where R is the cubemap's side. The weights sum to one.

    The weight is proportional to the number of pixels, in all cameras, that mirror the light around the texel. If no pixel mirrors the
    light, the weights are proportional to the texels' solid angles. Surfels nearer to a camera than `near` are not drawn.

    A term of the loss pulls the weighted mean of the light towards grey. With equal weights, this term could give wrong colours to the
    light in directions that few pixels mirror.
    """
    pixels = torch.zeros(6 * SIDE * SIDE)
    settings = settings.model_copy(update={"reflection": "microfacet"})  # treat matte surfaces as reflective here
    for camera in (camera.fitted(PIXELS) for camera in cameras):
        lit = stack(channels(surfels, camera, settings, indirect=True))
        features, _, alpha = rasterize(*discs(surfels, camera), lit, camera, near=near)
        turn = torch.from_numpy(light.turn(camera)).float().T
        seen = cubemap.texels_at(mirror_directions(features, alpha, camera)[alpha > SOLID].cpu() @ turn, SIDE)
        pixels += torch.bincount(seen, minlength=len(pixels))
    part = cubemap.texels_in(light.resolution, SIDE, pixels.device)
    weights = (pixels / torch.bincount(part, minlength=len(pixels)).clamp_min(1))[part]
    if not pixels.any():
        weights = cubemap.texel_solid_angles(light.resolution).float()
    return (weights / weights.sum()).to(light.radiance.device)
