"""Compute the same as the rendering kernels, but in float64 with plain torch and its autograd. Tests compare the kernels with this module.

The code is simple and slow: the rasteriser evaluates every splat at every pixel.
"""

import math
from typing import cast

import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.color import srgb_encode
from refgs.model import cubemap, prefilter
from refgs.render.brdf import LEAST_N_V, reflectance, reflectance_table

ALPHA_CUT, ALPHA_CAP, MIN_TRANSMITTANCE, LOW_PASS, FAR = 1 / 255, 0.99, 1e-4, 8.0, 1e12  # as in splat.h
COVERED, SHIFT_LIMIT, SHIFT_ALPHA, SHIFT_BEND = 1 / 255, 8.0, 0.3, 5.0  # as in pixels.h


def rotation_matrices(q: Tensor) -> Tensor:
    """Convert quaternions wxyz of any length to matrices (N, 3, 3), zero to the identity."""
    norm = q.norm(dim=-1, keepdim=True)
    unit = torch.tensor([1.0, 0, 0, 0], dtype=q.dtype)
    w, x, y, z = torch.where(norm < 1e-12, unit, q / norm.clamp_min(1e-12)).unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def rasterize(
    positions: Tensor,
    rotations: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    near: float,
    upper: float = 1.0,
    lower: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rasterise float64 tensors as `refgs.render.rasterize.rasterize` does. Returns features, depth, alpha, and a margin (H, W).

    Depth counts only the share of each surfel's weight that lies between the transmittances `upper` and `lower` (see `trimmed_depth`).

    A pixel depends on comparisons with thresholds, such as the least alpha. The margin is the smallest relative distance from any of these
    thresholds. Where it is tiny, a rounding error can change the pixel.
    """
    view = torch.from_numpy(camera.world_to_camera).to(positions.dtype)
    centre = positions @ view[:3, :3].T + view[:3, 3]
    drawn = (centre[:, 2] >= near) & (centre[:, 2] <= FAR) & (opacities >= ALPHA_CUT)
    order = torch.argsort(centre[:, 2].float(), stable=True)
    order = order[drawn[order]]
    c, o, f = centre[order], opacities[order], features[order]
    axes = (view[:3, :3] @ rotation_matrices(rotations[order]))[:, :, :2] * scales[order][:, None, :]
    a, b = axes.unbind(-1)

    y, x = torch.meshgrid(
        torch.arange(camera.height, dtype=c.dtype) + 0.5, torch.arange(camera.width, dtype=c.dtype) + 0.5, indexing="ij"
    )
    ray = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], dim=-1)
    # Eq. 4: [a b c] (u, v, 1) = z ray, by Cramer's rule
    n0, n1, n2 = (ray @ torch.linalg.cross(p, q).T for p, q in ((b, c), (c, a), (a, b)))
    determinant = (c * torch.linalg.cross(a, b)).sum(dim=-1)
    ahead = n2 * determinant > 0
    safe = torch.where(ahead, n2, 1)
    u, v, z = n0 / safe, n1 / safe, determinant / safe
    met = ahead & (z >= near) & (z <= FAR)
    on_plane = u * u + v * v
    centre_x, centre_y = camera.fx * c[:, 0] / c[:, 2] + camera.cx, camera.fy * c[:, 1] / c[:, 2] + camera.cy
    on_screen = LOW_PASS * ((x[..., None] - centre_x) ** 2 + (y[..., None] - centre_y) ** 2)
    plane = met & (on_plane <= on_screen)
    rho = torch.where(plane, on_plane, on_screen)
    z = torch.where(plane, z, c[:, 2].expand_as(z))
    raw = o * torch.exp(-rho / 2)
    alpha = torch.where(raw >= ALPHA_CUT, raw.clamp_max(ALPHA_CAP), 0)
    before = torch.cumprod(torch.cat([torch.ones_like(x)[..., None], 1 - alpha], dim=-1), dim=-1)[..., :-1]
    weight = torch.where(before >= MIN_TRANSMITTANCE, alpha * before, 0)
    after = before - weight
    part = before.clamp(lower, upper) - after.clamp(lower, upper)
    maps = weight @ f, (part * z).sum(dim=-1), weight.sum(dim=-1)

    with torch.no_grad():  # in the order of the rules: on the plane or not, near or not, cut, capped, finished
        seen = before >= MIN_TRANSMITTANCE * 0.99
        if_met = ahead & (on_plane <= 1.01 * on_screen)
        # Where a pixel's centre is a surfel's, both are rounding's, and so is which of them depth takes its derivatives from.
        nearer = (on_plane + 1e-6) / (on_screen + 1e-6)
        margins = [
            torch.where(if_met & (o * torch.exp(-on_plane / 2) > 0.99 * ALPHA_CUT), (z / near).log().abs(), math.inf),
            torch.where(met & (raw > 0.99 * ALPHA_CUT), nearer.log().abs(), math.inf),
            (raw / ALPHA_CUT).log().abs(),
            (raw / ALPHA_CAP).log().abs(),
            (before / MIN_TRANSMITTANCE).log().abs(),
        ]
        margin = torch.where(seen[None], torch.stack(margins), math.inf).amin(dim=0)
        margin = torch.cat([margin, torch.full_like(x, math.inf)[..., None]], dim=-1).amin(dim=-1)
    return *maps, margin


def unit(v: Tensor) -> Tensor:
    return v * torch.rsqrt((v * v).sum(dim=-1, keepdim=True) + 1e-24)


def shade(
    features: Tensor,
    alpha: Tensor,
    levels: Tensor,
    sides: tuple[int, ...],
    camera: Camera,
    background: Tensor,
    visibility: Tensor | None = None,
    exposure: Tensor | float = 1.0,
    turn: Tensor | None = None,
    display: bool = False,
    mirror: bool = False,
    by_direction: bool = False,
    matte: bool = False,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Shade float64 tensors as `refgs.render.shade.shade` does. Returns picture, normal, material, radiance, and a margin (H, W).

    `levels` and `sides` are the prefiltered light. `turn` (3, 3) rotates directions from the world's axes to the light's.

    Derivatives jump at some values: for example, those of a bilinear look-up jump at texel centres. The margin is a pixel's smallest
    distance from such a value. Where it is tiny, a rounding error can change a derivative.
    """
    view, pixels = torch.from_numpy(camera.world_to_camera), torch.nonzero(alpha > COVERED, as_tuple=True)
    here, margins = alpha[pixels], []
    own = features[pixels] / here[:, None]
    maps = _with_matte_material(own) if matte else _displaced(features, alpha, own, pixels, camera, margins)

    row, column = (index + 0.5 for index in pixels)
    ray = torch.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, torch.ones_like(here)], dim=-1)
    towards = -unit(ray @ view[:3, :3])
    indirect = None if visibility is None else (visibility[pixels][:, None], maps[:, 11:])
    given = levels, sides, indirect, margins, turn, mirror, matte
    radiance = radiance_towards(towards, maps, maps[:, 8:11] if by_direction else None, *given, blended=own[:, :3])
    exposed = exposure * radiance
    if not display:
        margins.append((exposed - 0.0031308).abs().amin(dim=-1))
    encoded = exposed if display else srgb_encode(exposed)
    color = encoded * here[:, None] + (1 - here[:, None]) * background

    def image(values: Tensor) -> Tensor:
        return values.new_zeros(*alpha.shape, values.shape[-1]).index_put(pixels, values)

    picture = background.expand(*alpha.shape, 3).index_put(pixels, color)
    margin = torch.full_like(alpha, math.inf).index_put(pixels, torch.stack(margins).amin(dim=0).detach())
    return picture, image(maps[:, :3]), image(maps[:, 3:8]), image(radiance), margin


def shade_splats(
    features: Tensor,
    levels: Tensor,
    sides: tuple[int, ...],
    camera: Camera,
    turn: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Shade float64 surfels like `refgs.render.shade.shade_splats`, giving radiance (N, 3) and the margins (N,) of `shade`."""
    towards, margins, matte = unit(torch.from_numpy(camera.position) - features[:, -3:]), [], features.shape[-1] == 6
    features = _with_matte_material(features) if matte else features
    appearance = features[:, 8:11] if features.shape[-1] > 11 else None
    radiance = radiance_towards(towards, features, appearance, levels, sides, None, margins, turn, matte=matte)
    return radiance, torch.stack(margins).amin(dim=0)


def radiance_towards(
    towards: Tensor,
    maps: Tensor,
    appearance: Tensor | None,
    levels: Tensor,
    sides: tuple[int, ...],
    indirect: tuple[Tensor, Tensor] | None,
    margins: list[Tensor],
    turn: Tensor | None = None,
    mirror: bool = False,
    matte: bool = False,
    blended: Tensor | None = None,
) -> Tensor:
    """Compute the radiance (P, 3) that P surface points send in unit directions `towards` (P, 3), by the split sum.

    The equations are Eq. 5–10 of the Ref-Gaussian paper.

    - `maps` (P, 8 or more): normal, albedo, metallic, roughness; with `indirect` also irradiance divided by that of an unoccluded surface
    - `appearance` (P, 3): a colour that replaces diffuse shading, or None
    - `levels`, `sides`: the prefiltered light. `turn` (3, 3) rotates directions from the world's axes to the light's.
    - `indirect`: None, or two tensors for the mirror direction. The first (P, 1) is 0 where the object occludes the direction, else 1. The
      second (P, 3) is the radiance that comes from the object in this direction.
    - `margins`: a list, to which distances from jumps of the derivatives are appended (see `shade`)
    - `mirror`, `matte`: as in `refgs.render.shade.shade`
    - `blended` (P, 3): normals for irradiance, or None for those in `maps`
    """
    normal, albedo, (metallic, roughness) = unit(maps[:, :3]), maps[:, 3:6], maps[:, 6:8].unbind(-1)
    facing = normal if blended is None else unit(blended)
    if turn is not None:
        normal, facing, towards = normal @ turn.T, facing @ turn.T, towards @ turn.T
    if matte:
        _cube_margins(normal, [torch.tensor(sides[-1])], margins)
        return albedo * prefilter.irradiance(levels, sides, normal)
    dot = (normal * towards).sum(dim=-1)
    roughness = torch.zeros_like(roughness) if mirror else roughness
    light = specular(levels, sides, 2 * dot[:, None] * normal - towards, roughness, margins)
    if indirect is not None:  # Eq. 9
        free, from_object = indirect
        light = free * light + (1 - free) * from_object
    share = metallic[:, None]
    if mirror:
        if appearance is None:
            raise ValueError("mirrors lie under a colour of their own")
        return light * share + (1 - share) * appearance
    at = torch.stack([dot, roughness], dim=-1)
    margins += [*(at - LEAST_N_V).abs().unbind(-1)]
    margins += _from_integer(at.clamp(LEAST_N_V, 1).sqrt() * (len(reflectance_table()) - 1))
    metal, dielectric = reflectance(dot, roughness, albedo)
    if appearance is not None:
        diffuse = (1 - share) * appearance
    else:
        received = prefilter.irradiance(levels, sides, facing)
        _cube_margins(facing, [torch.tensor(sides[-1])], margins)
        reaching = 1 if indirect is None else maps[:, 8:11]
        diffuse = (1 - share) * (1 - dielectric) * albedo * received * reaching
    return light * ((1 - share) * dielectric + share * metal) + diffuse


def _with_matte_material(maps: Tensor) -> Tensor:
    """Extend normals and albedos (P, 6) by metallic 0 and roughness 1 to (P, 8)."""
    return torch.cat([maps, maps.new_tensor([0.0, 1.0]).expand(len(maps), 2)], dim=1)


def _displaced(features, alpha, own, pixels, camera: Camera, margins: list[Tensor]) -> Tensor:
    view, (height, width) = torch.from_numpy(camera.world_to_camera), alpha.shape
    here = alpha[pixels]
    point = own[:, -3:] @ view[:3, :3].T + view[:3, 3]
    focal, middle = torch.tensor([camera.fx, camera.fy]).double(), torch.tensor([camera.cx, camera.cy]).double()
    centre = torch.stack([pixels[1], pixels[0]], dim=-1).double()
    shift = point[:, :2] / point[:, 2:] * focal + middle - centre - 0.5
    margins += [*(shift.abs() - SHIFT_LIMIT).abs().unbind(-1), (here - SHIFT_ALPHA).abs()]
    last = torch.tensor([width - 1, height - 1]).double()
    limited = shift.clamp(-SHIFT_LIMIT, SHIFT_LIMIT) * (here > SHIFT_ALPHA)[:, None]
    to = centre - limited
    moves = (here > SHIFT_ALPHA)[:, None] & (shift.abs() < SHIFT_LIMIT) & (to > 0) & (to < last)
    margins += _from_integer(to, moves)
    to = to.clamp_min(0).minimum(last)
    stacked = torch.cat([features[..., :3], alpha[..., None]], dim=-1)
    low = to.detach().floor()
    x, y = (to - low).unbind(-1)
    (x0, y0), (x1, y1) = low.long().unbind(-1), (low + 1).minimum(last).long().unbind(-1)
    corners = stacked[y0, x0], stacked[y0, x1], stacked[y1, x0], stacked[y1, x1]
    weights = (1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y
    sampled = cast(Tensor, sum(w[:, None] * c for w, c in zip(weights, corners, strict=True)))
    there = sampled[:, -1]
    margins += [(there - SHIFT_ALPHA).abs()]
    moved = sampled[:, :-1] / there.clamp_min(SHIFT_ALPHA)[:, None]
    turned = (unit(moved) - unit(own[:, :3])).norm(dim=-1) / point[:, 2]
    bent = (SHIFT_BEND * limited / focal).norm(dim=-1) ** 2 + 1e-12
    trust = ((there - SHIFT_ALPHA) / SHIFT_ALPHA).clamp(0, 1) * bent / (bent + turned**2)
    trust = trust.detach()[:, None]
    return torch.cat([trust * moved + (1 - trust) * own[:, :3], own[:, 3:-3]], dim=-1)


def _from_integer(x: Tensor, counts: Tensor | bool = True) -> list[Tensor]:
    distance = (x - x.round()).abs().detach()
    return list(torch.where(torch.as_tensor(counts), distance, math.inf).unbind(-1))


def _cube_margins(directions: Tensor, sides: list[Tensor], margins: list) -> None:
    _, s, t = cubemap.face_coordinates(directions)
    largest = torch.sort(directions.abs(), dim=-1).values
    margins.append((largest[:, 2] - largest[:, 1]).abs())
    for half in (side / 2 for side in sides):
        margins += _from_integer(torch.stack([(s + 1) * half + 0.5, (t + 1) * half + 0.5], dim=-1))


def specular(levels: Tensor, sides: tuple[int, ...], directions: Tensor, roughness: Tensor, margins: list) -> Tensor:
    """Look up the prefiltered light in P unit directions (P, 3), for roughnesses (P,). Returns the radiance (P, 3).

    `levels` are what `prefilter` returns, and `sides` are their sides in texels. Radiance is interpolated, so its derivatives jump where a
    look-up passes from one texel or level to the next. The distance of each look-up from such a jump is appended to `margins` (see
    `shade`).
    """
    known, alpha = torch.tensor(prefilter.ROUGHNESS, dtype=roughness.dtype), roughness**2
    interval = (torch.bucketize(roughness.detach().contiguous(), known) - 1).clamp(0, len(known) - 2)
    low, high = known[interval] ** 2, known[interval + 1] ** 2
    margins.append((roughness[:, None] - known[1:-1]).abs().amin(dim=-1))
    _cube_margins(directions, [torch.tensor(sides)[interval + i] for i in (0, 1)], margins)
    levels = cubemap.in_texel_order(levels, sides)
    return cubemap.sample(levels, sides, directions, interval + (alpha - low) / (high - low))


def dssim(image: Tensor, target: Tensor) -> Tensor:
    """Compute the structural dissimilarity 1 − mean SSIM, as `refgs.render.ssim.dssim` does."""
    k = torch.arange(-5, 6, dtype=image.dtype)
    window = torch.exp(-(k**2) / (2 * 1.5**2))
    window = torch.outer(window, window) / window.sum() ** 2

    def blur(v: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(v.permute(2, 0, 1)[:, None], window[None, None], padding=5)

    x, y = blur(image), blur(target)
    xx, yy, xy = blur(image**2) - x**2, blur(target**2) - y**2, blur(image * target) - x * y
    ssim = (2 * x * y + 1e-4) * (2 * xy + 9e-4) / ((x**2 + y**2 + 1e-4) * (xx + yy + 9e-4))
    return 1 - ssim.mean()
