"""The one renderer: surfels and light in, picture and maps out. Training, evaluation and export all call it."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.clock import timed
from refgs.color import srgb_decode, srgb_encode
from refgs.geometry.visibility import Occluder
from refgs.kernels import load
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.directional import directional
from refgs.render.facing import facing_normals
from refgs.render.rasterize import rasterize
from refgs.render.shade import mirror_directions, shade, shade_splats
from refgs.render.stack import stack
from refgs.render.volume import discs, with_normals_last
from refgs.settings import RenderSettings

NEAR = 0.01  # the nearest depth that is drawn, in scene radii
COVERED = 1 / 255  # pixels with less alpha than this are background
SIGNED = 1.0  # what is added to a colour that may be negative while it is blended


@dataclass(frozen=True)
class Rendering:
    """What a camera sees. `color` (H, W, 3) is sRGB-encoded, over the background. The maps are alpha-weighted means over
    the splats of a pixel, linear, zero where nothing is: `normal` (H, W, 3) in world space, not normalised, towards the
    camera; `depth` (H, W) along the camera's axis, of which `blended_depth` is the sum that is divided by alpha. Where
    there is a light, `material` (H, W, 5) is albedo, metallic, roughness. With inter-reflection, `visibility` (H, W) is 0
    where the object itself stands in the mirror direction, else 1. `background` (3,) and `exposure`, a scalar, are what was
    given."""

    color: Tensor
    alpha: Tensor
    blended_depth: Tensor
    normal: Tensor
    material: Tensor | None = None
    visibility: Tensor | None = None
    background: Tensor | None = None
    exposure: Tensor | None = None

    @property
    def depth(self) -> Tensor:
        return self.blended_depth / self.alpha.clamp_min(COVERED)

    @property
    def radiance(self) -> Tensor:
        """What the splats of a pixel send to the camera (H, W, 3), linear, before exposure; zero where nothing is."""
        alpha = self.alpha[..., None]
        mean = (self.color - (1 - alpha) * self.background) / alpha.clamp_min(COVERED)
        radiance = srgb_decode(mean.clamp_min(0)) * (alpha > COVERED)
        return radiance if self.exposure is None else radiance / self.exposure

    @property
    def albedo(self) -> Tensor:
        return self.material[..., :3]

    @property
    def metallic(self) -> Tensor:
        return self.material[..., 3]

    @property
    def roughness(self) -> Tensor:
        return self.material[..., 4]


def near_plane(radius: float) -> float:
    """The nearest depth that is drawn in a scene of this radius, both in world units."""
    return NEAR * radius


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.sqrt(np.einsum("pa,pa->p", v, v) + 1e-24)[:, None]


@timed("visibility")
def _visibility(features: Tensor, alpha: Tensor, depth: Tensor, camera: Camera, occluder: Occluder) -> Tensor:
    """1 where the mirror direction of a pixel is free of the object (H, W), else 0."""
    directions = mirror_directions(features, alpha, camera)
    if load.on_gpu(alpha):
        return occluder.tree(alpha.device).visible(directions, alpha, depth, camera)
    covered = np.flatnonzero(alpha.detach().numpy() > COVERED)
    mirrored = directions.numpy().reshape(-1, 3)[covered]
    row, column = np.divmod(covered, camera.width)
    local = np.stack([(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, np.ones(len(row))])
    rays = local.T @ camera.world_to_camera[:3, :3]
    mean_depth = (depth / alpha).detach().numpy().reshape(-1, 1)[covered]
    points = rays * mean_depth + camera.position
    normals = mirrored - _unit(rays)  # half way back to the camera
    visible = np.ones(alpha.shape, np.float32)
    visible.reshape(-1)[covered] = occluder.visible(points, _unit(normals), mirrored)
    return torch.from_numpy(visible)


def channels(surfels: Surfels, camera: Camera, settings: RenderSettings, indirect: bool) -> list[Tensor]:
    """What `shade` takes of surfels, as a camera sees them, (N, C) each: normals, albedo, metallic, roughness; colour by direction
    where there is any; with `indirect`, if not what part of the irradiance they receive, and radiance from the object itself;
    positions. Of what mirrors nothing normals and albedo."""
    normals = facing_normals(with_normals_last(surfels).rotations, surfels.positions, camera)
    if settings.shading != "sh" and settings.reflection == "none":
        return [normals, surfels.albedo]
    lit = [normals, surfels.albedo, surfels.metallic, surfels.roughness]
    if settings.shading == "sh" or settings.diffuse == "sh":
        lit.append(directional(surfels.sh_dc, surfels.sh_rest, 0.5, surfels.positions, camera))
    elif indirect:
        lit.append(surfels.received)
    if indirect:
        lit.append(directional(surfels.indirect_dc, surfels.indirect_rest, 0.0, surfels.positions, camera, normals))
    return [*lit, surfels.positions]


def render(
    surfels: Surfels,
    environment: Environment | None,
    camera: Camera,
    background: Tensor,
    settings: RenderSettings,
    near: float,
    occluder: Occluder | None = None,
    exposure: Tensor | None = None,
) -> Rendering:
    """Render surfels for a camera over a background (3,), sRGB-encoded.

    `settings.shading` is "deferred" (split-sum shading of blended maps, paper Eq. 5–8), "splat" (of each surfel, then
    blended, paper §3.3) or "sh" (view-dependent colour of each surfel, blended). `near` is in world units. With an
    `occluder`, deferred shading takes the surfels' own light in place of the environment's where that is in the way of the
    mirror direction (paper Eq. 9). Radiance is multiplied by an `exposure`, a scalar, where there is one, before it is
    encoded. `settings.reflection` says what reflects, `settings.color_space` whether radiance is linear or a screen's numbers.

    Deferred shading with a diffuse part from the environment leaves something over, normals being a pixel's mean and light being
    traced once: harmonics that the surfels have beyond the constant are a colour by direction that is added to the picture, encoded.
    """
    deferred, display = settings.shading == "deferred", settings.color_space == "display"
    mirror, matte = settings.reflection == "mirror", settings.reflection == "none"
    occluder = None if matte else occluder
    lit = channels(surfels, camera, settings, deferred and occluder is not None)
    if settings.shading == "splat":
        blended = [lit[0], shade_splats(stack(lit), environment, camera, mirror), *lit[1 : 2 if matte else 4]]
    else:
        blended = lit if deferred else [lit[0], lit[4]]
    adds = deferred and settings.diffuse == "irradiance" and surfels.sh_rest.shape[1] > 0
    if adds:
        none = torch.zeros_like(surfels.sh_dc)
        blended = [directional(none, surfels.sh_rest, SIGNED, surfels.positions, camera), *blended]
    features, depth, alpha = rasterize(*discs(surfels, camera), stack(blended), camera, near=near)
    if deferred:
        if adds:
            residual, features = features.split((3, features.shape[-1] - 3), dim=-1)
        visibility = None if occluder is None else _visibility(features, alpha, depth, camera, occluder)
        how = display, mirror, settings.diffuse == "sh", matte
        shaded = shade(features, alpha, environment, camera, background, visibility, exposure, *how)
        color = shaded.color + (residual - SIGNED * alpha[..., None]) if adds else shaded.color
        return Rendering(color, alpha, depth, shaded.normal, shaded.material, visibility, background, exposure)
    over = (1 - alpha[..., None]) * background
    if settings.shading == "sh":
        normal, color = features.split(3, dim=-1)
        mean = normal / alpha.clamp_min(COVERED)[..., None]
        return Rendering(color + over, alpha, depth, mean, background=background)
    normal, mean, *material = (features / alpha.clamp_min(COVERED)[..., None]).split((3, 3, 3 if matte else 5), dim=-1)
    material = (
        torch.cat([*material, alpha.new_tensor([0.0, 1.0]).expand(*alpha.shape, 2)], dim=-1) if matte else material[0]
    )
    exposed = mean if exposure is None else exposure * mean
    encoded = exposed if display else srgb_encode(exposed)
    return Rendering(encoded * alpha[..., None] + over, alpha, depth, normal, material, None, background, exposure)
