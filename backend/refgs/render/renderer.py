"""The one renderer: surfels and light in, picture and maps out. Training, evaluation and export all call it."""

from dataclasses import dataclass

import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.model import harmonics
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.rasterize import rasterize
from refgs.render.shade import shade
from refgs.settings import RenderSettings

NEAR = 0.01  # the nearest depth that is drawn, in scene radii
COVERED = 1 / 255  # pixels with less alpha than this are background
PAST_HORIZON = -0.3  # cosine below which a surfel shows its back


@dataclass(frozen=True)
class Rendering:
    """What a camera sees. `color` (H, W, 3) is sRGB-encoded, over the background. The maps are alpha-weighted means over
    the splats of a pixel, linear, zero where nothing is: `normal` (H, W, 3) in world space, not normalised, towards the
    camera; `depth` (H, W) along the camera's axis. Deferred shading has two more: `material` (H, W, 5) is albedo,
    metallic, roughness; `radiance` (H, W, 3) is before the background."""

    color: Tensor
    alpha: Tensor
    depth: Tensor
    normal: Tensor
    material: Tensor | None = None
    radiance: Tensor | None = None

    @property
    def albedo(self) -> Tensor:
        return self.material[..., :3]

    @property
    def metallic(self) -> Tensor:
        return self.material[..., 3]

    @property
    def roughness(self) -> Tensor:
        return self.material[..., 4]


def unit(v: Tensor) -> Tensor:
    """Vectors (..., 3) made unit length; a zero vector stays zero. Three times as fast as torch's normalize for three numbers."""
    x, y, z = v.unbind(-1)
    return v * torch.rsqrt(x * x + y * y + z * z + 1e-24)[..., None]


def near_plane(radius: float) -> float:
    """The nearest depth that is drawn in a scene of this radius, both in world units."""
    return NEAR * radius


def camera_rays(camera: Camera) -> Tensor:
    """Directions (H, W, 3) in the world through the pixels' centres, with unit depth along the camera's axis; float32."""
    x = (torch.arange(camera.width, dtype=torch.float64) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=torch.float64) + 0.5 - camera.cy) / camera.fy
    rotation = torch.from_numpy(camera.world_to_camera[:3, :3].copy())
    rays = rotation[2] + x[None, :, None] * rotation[0] + y[:, None, None] * rotation[1]
    return rays.float()


def facing_normals(surfels: Surfels, camera: Camera) -> Tensor:
    """The surfels' normals (N, 3), turned towards the camera where they look well away from it.

    Not where they hardly do: on a closed surface those lie just past the horizon and show at the silhouette, where
    turning them would point the blend anywhere.
    """
    normals = surfels.normals()
    towards = torch.from_numpy(camera.position).float() - surfels.positions.detach()
    cosine = (normals.detach() * unit(towards)).sum(dim=-1, keepdim=True)
    return torch.where(cosine < PAST_HORIZON, -normals, normals)


def _appearance(surfels: Surfels, camera: Camera) -> Tensor:
    """SH colour (N, 3) of each surfel towards the camera, not negative."""
    towards = surfels.positions.detach() - torch.from_numpy(camera.position).float()
    return harmonics.evaluate(surfels.sh, unit(towards)).clamp_min(0)


def render(
    surfels: Surfels,
    environment: Environment | None,
    camera: Camera,
    background: Tensor,
    settings: RenderSettings,
    near: float,
) -> Rendering:
    """Render surfels for a camera over a background (3,), sRGB-encoded.

    `settings.shading` is "deferred" (split-sum shading of blended maps, paper Eq. 5–8) or "sh" (view-dependent colour
    of each surfel, blended). `near` is in world units.
    """
    deferred = settings.shading == "deferred"
    parts = [facing_normals(surfels, camera)]
    if deferred:
        parts += [surfels.albedo, surfels.metallic[:, None], surfels.roughness[:, None]]
    if not deferred or settings.diffuse == "sh":
        parts.append(_appearance(surfels, camera))
    if deferred:
        parts.append(surfels.positions)
    geometry = surfels.positions, surfels.rotations, surfels.scales, surfels.opacities
    features, depth, alpha = rasterize(*geometry, torch.cat(parts, dim=1), camera, near=near)
    depth = depth / alpha.clamp_min(COVERED)
    if deferred:
        shaded = shade(features, alpha, environment, camera, background)
        return Rendering(shaded.color, alpha, depth, shaded.normal, shaded.material, shaded.radiance)
    normal, appearance = features.split(3, dim=-1)
    color = appearance + (1 - alpha[..., None]) * background
    return Rendering(color, alpha, depth, normal / alpha.clamp_min(COVERED)[..., None])
