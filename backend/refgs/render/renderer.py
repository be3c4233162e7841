"""The one renderer: surfels and light in, picture and maps out. Training, evaluation and export all call it."""

from dataclasses import dataclass

import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.color import srgb_encode
from refgs.model import harmonics
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render import brdf
from refgs.render.rasterize import rasterize
from refgs.settings import RenderSettings

NEAR = 0.01  # the nearest depth that is drawn, in scene radii
COVERED = 1 / 255  # pixels with less alpha than this are background
PAST_HORIZON = -0.3  # cosine below which a surfel shows its back
SHIFT_LIMIT = 8.0  # pixels
SHIFT_ALPHA = 0.3  # a silhouette's blended position says nothing about its surface


@dataclass(frozen=True)
class Rendering:
    """What a camera sees. `color` (H, W, 3) is sRGB-encoded, over the background. The maps are alpha-weighted means over
    the splats of a pixel, linear, zero where nothing is: `normal` (H, W, 3) in world space, not normalised, towards the
    camera; `depth` (H, W) along the camera's axis. `shaded` has what deferred shading worked with, by covered pixel."""

    color: Tensor
    alpha: Tensor
    depth: Tensor
    normal: Tensor
    pixels: tuple[Tensor, Tensor] | None = None
    shaded: dict[str, Tensor] | None = None

    def map(self, name: str) -> Tensor:
        """ "albedo" or "radiance" (H, W, 3), "metallic" or "roughness" (H, W), linear; radiance is before the background."""
        values = self.shaded[name]
        return self.alpha.new_zeros(*self.alpha.shape, *values.shape[1:]).index_put(self.pixels, values)


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


def _unshifted(features: Tensor, alpha: Tensor, position: int, pixels: tuple[Tensor, Tensor], camera: Camera) -> Tensor:
    """Features (P, C) of the covered pixels, alpha-weighted means, read where the blend's own surface point projects to the pixel.

    Discs sorted and blended by their centres favour those in front: on a curved surface the blend at a pixel is that of
    a point nearer to the camera, whose normal leans towards it. The blended positions tell which point; the pixel whose
    blend is *this* pixel's point lies the same way back. Gradients go through the displacement.
    """
    height, width, channels = features.shape
    rotation = torch.from_numpy(camera.world_to_camera[:3, :3].copy()).float()
    translation = torch.from_numpy(camera.world_to_camera[:3, 3].copy()).float()
    stacked = torch.cat([features, alpha[..., None]], dim=-1)
    *own, here = stacked[pixels].split([channels, 1], dim=-1)
    own = own[0] / here
    centre = torch.stack([pixels[1], pixels[0]], dim=-1) + 0.5
    point = own[:, position : position + 3] @ rotation.T + translation
    focal = torch.tensor([camera.fx, camera.fy])
    projected = point[:, :2] / point[:, 2:].clamp_min(1e-12) * focal + torch.tensor([camera.cx, camera.cy])
    shift = (projected - centre).clamp(-SHIFT_LIMIT, SHIFT_LIMIT) * (here.detach() > SHIFT_ALPHA)
    grid = (centre - shift) * torch.tensor([2 / width, 2 / height]) - 1
    sampled = torch.nn.functional.grid_sample(
        stacked.permute(2, 0, 1)[None], grid[None, :, None], mode="bilinear", padding_mode="border", align_corners=False
    )[0, :, :, 0]
    # At a silhouette the way back leads off the object: there the pixel keeps its own blend.
    there = sampled[channels]
    trust = ((there.detach() - SHIFT_ALPHA) / SHIFT_ALPHA).clamp(0, 1)[:, None]
    moved = (sampled[:channels] / there.clamp_min(SHIFT_ALPHA)).T
    return trust * moved + (1 - trust) * own


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
    parts = {"normal": facing_normals(surfels, camera)}
    if deferred:
        parts |= {"position": surfels.positions, "albedo": surfels.albedo}
        parts |= {"metallic": surfels.metallic[:, None], "roughness": surfels.roughness[:, None]}
    if not deferred or settings.diffuse == "sh":
        parts["appearance"] = _appearance(surfels, camera)
    widths = [p.shape[1] for p in parts.values()]
    raster = rasterize(
        surfels.positions,
        surfels.rotations,
        surfels.scales,
        surfels.opacities,
        torch.cat(list(parts.values()), dim=1),
        camera,
        near=near,
    )
    alpha = raster.alpha
    depth = raster.depth / alpha.clamp_min(COVERED)
    if not deferred:
        maps = dict(zip(parts, raster.features.split(widths, dim=-1), strict=True))
        color = maps["appearance"] + (1 - alpha[..., None]) * background
        return Rendering(color, alpha, depth, maps["normal"] / alpha.clamp_min(COVERED)[..., None])

    pixels = torch.nonzero(alpha.detach() > COVERED, as_tuple=True)
    features = _unshifted(raster.features, alpha, sum(widths[: list(parts).index("position")]), pixels, camera)
    maps = dict(zip(parts, features.split(widths, dim=-1), strict=True))

    view = -unit(camera_rays(camera)[pixels])
    normal = unit(maps["normal"])
    n_v = (normal * view).sum(dim=-1).clamp(1e-4, 1)
    metallic, roughness = maps["metallic"][:, 0], maps["roughness"][:, 0]
    light = environment.specular(brdf.reflect(view, normal), roughness)
    radiance, base = brdf.specular(maps["albedo"], metallic, n_v, roughness, light)
    if settings.diffuse == "sh":  # the paper's substitute: SH colour in place of integrated diffuse light
        radiance = radiance + (1 - metallic[:, None]) * maps["appearance"]
    else:
        radiance = radiance + base * maps["albedo"] * environment.diffuse(normal)

    covered = alpha[pixels][:, None]
    over = srgb_encode(radiance) * covered + (1 - covered) * background
    color = background.expand(camera.height, camera.width, 3).index_put(pixels, over)
    blended = torch.zeros_like(color).index_put(pixels, maps["normal"])
    shaded = {"albedo": maps["albedo"], "metallic": metallic, "roughness": roughness, "radiance": radiance}
    return Rendering(color, alpha, depth, blended, pixels, shaded)
