"""Render surfels under a light into a picture and maps. Training, evaluation and export all call this renderer."""

import numpy as np
import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.clock import timed
from refgs.geometry.project import pixel_rays
from refgs.geometry.visibility import Occluder
from refgs.kernels import load
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.baselines import method_of
from refgs.render.channels import channels
from refgs.render.directional import directional
from refgs.render.rasterize import rasterize
from refgs.render.relight import Relit
from refgs.render.rendering import COVERED, Rendering
from refgs.render.shade import mirror_directions, shade
from refgs.render.stack import stack
from refgs.render.volume import discs
from refgs.settings import RenderSettings

NEAR = 0.01  # the nearest depth that is drawn, in scene radii
ROUGHNESS = 7  # channel of the blended features
# Up to a roughness of SMOOTH, one mirror ray is better than harmonics of degree 3; from ROUGH on, it is worse.
SMOOTH, ROUGH = 0.3, 0.5
SIGNED = 1.0  # added to the residual while it is blended: it may be negative, and `directional` clamps at 0


def near_plane(radius: float) -> float:
    """Return the smallest drawn depth, in world units, in a scene of this radius."""
    return NEAR * radius


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.sqrt(np.einsum("pa,pa->p", v, v) + 1e-24)[:, None]


@timed("visibility")
def _visibility(
    features: Tensor, alpha: Tensor, depth: Tensor, camera: Camera, occluder: Occluder, relit: Relit | None = None
) -> Tensor:
    """Return 0 (H, W) where the object blocks a pixel's mirror ray, else 1.

    With `relit`, the radiance that smooth surfaces mirror of the object is changed, in place, to what their rays meet.
    """
    directions = mirror_directions(features, alpha, camera)
    if load.on_gpu(alpha):
        return occluder.tree(alpha.device).visible(directions, alpha, depth, camera)
    covered = np.flatnonzero(alpha.detach().numpy() > COVERED)
    mirrored = directions.numpy().reshape(-1, 3)[covered]
    row, column = np.divmod(covered, camera.width)
    rays = pixel_rays(camera, row, column)
    mean_depth = (depth / alpha).detach().numpy().reshape(-1, 1)[covered]
    points = rays * mean_depth + camera.position
    normals = mirrored - _unit(rays)  # half way back to the camera
    visible = torch.ones(alpha.shape)
    face, weights = occluder.meet(points, _unit(normals), mirrored)
    met = face >= 0
    pixels = torch.from_numpy(covered[met])
    visible.view(-1)[pixels] = 0
    if relit is not None and met.any():
        radiance = relit.mirrored(face[met], weights[met], mirrored[met])
        blended, whole = features.view(-1, features.shape[-1]), alpha.view(-1)[pixels, None]
        sharp = ((ROUGH - blended[pixels, ROUGHNESS, None] / whole) / (ROUGH - SMOOTH)).clamp(0, 1)
        blended[pixels, -6:-3] = torch.lerp(blended[pixels, -6:-3], radiance * whole, sharp)
    return visible


def render(
    surfels: Surfels,
    environment: Environment | None,
    camera: Camera,
    background: Tensor,
    settings: RenderSettings,
    near: float,
    occluder: Occluder | None = None,
    exposure: Tensor | None = None,
    relit: Relit | None = None,
) -> Rendering:
    """Render surfels for a camera: blend their features, then shade each pixel by the split sum (Ref-Gaussian paper, Eq. 5–8).

    `background` (3,) is sRGB-encoded. `near`, the smallest depth that is drawn, is in world units. `exposure` (3,) multiplies red, green
    and blue radiance before it is encoded.

    `occluder` is the object's mesh, for reflections of the object in itself. Where the mesh blocks a pixel's mirror direction, the pixel
    reflects radiance from the object. The surfels store this radiance (Ref-Gaussian paper, Eq. 9). Other pixels reflect `environment`.
    With `relit`, the object under another light whose surfels are given, smooth surfaces instead reflect what their mirror rays meet.

    If the setting diffuse is "irradiance", `surfels.sh_rest` may hold a residual: a view-dependent colour, sRGB-encoded, that is added to
    the picture. It stands for what material and light cannot explain in the photos.
    """
    method = method_of(settings)
    if method.draw is not None:
        return method.draw(surfels, environment, camera, background, settings, near, occluder, exposure)
    if environment is None:
        raise ValueError("there is no light to shade with")
    matte = settings.reflection == "none"
    occluder = None if matte else occluder
    blended = channels(surfels, camera, settings, indirect=occluder is not None)
    has_residual = settings.diffuse == "irradiance" and surfels.sh_rest.shape[1] > 0
    residual = None
    if has_residual:
        none = torch.zeros_like(surfels.sh_dc)
        blended = [directional(none, surfels.sh_rest, SIGNED, surfels.positions, camera), *blended]
    features, depth, alpha = rasterize(*discs(surfels, camera), stack(blended), camera, near=near)
    if has_residual:
        residual, features = features.split((3, features.shape[-1] - 3), dim=-1)
    visibility = None if occluder is None else _visibility(features, alpha, depth, camera, occluder, relit)
    how = method.light.display, method.mirror, settings.diffuse == "sh", matte
    shaded = shade(features, alpha, environment, camera, background, visibility, exposure, *how)
    color = shaded.color if residual is None else shaded.color + (residual - SIGNED * alpha[..., None])
    return Rendering(color, alpha, depth, shaded.normal, shaded.material, visibility, background, exposure)
