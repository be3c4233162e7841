"""What the kernels compute, in a few lines of torch: dense over pixels × splats, float64, autograd. The tests' oracle."""

import math

import torch
from torch import Tensor

from refgs.camera import Camera

ALPHA_CUT, ALPHA_CAP, MIN_TRANSMITTANCE, LOW_PASS, FAR = 1 / 255, 0.99, 1e-4, 2.0, 1e12  # as in splat.h


def rotation_matrices(q: Tensor) -> Tensor:
    """(N, 3, 3) from quaternions wxyz (N, 4) of any length; the identity for those without one."""
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
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """As refgs.render.rasterize.rasterize, for float64 tensors; and how far each pixel (H, W) is from a decision that
    rounding could turn: the smallest relative margin of all the comparisons that its value rests on."""
    view = torch.from_numpy(camera.world_to_camera)
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
    maps = weight @ f, (weight * z).sum(dim=-1), weight.sum(dim=-1)

    with torch.no_grad():  # in the order of the rules: on the plane or not, near or not, cut, capped, finished
        seen = before >= MIN_TRANSMITTANCE * 0.99
        if_met = ahead & (on_plane <= 1.01 * on_screen)
        margins = [
            torch.where(if_met & (o * torch.exp(-on_plane / 2) > 0.99 * ALPHA_CUT), (z / near).log().abs(), math.inf),
            torch.where(met & (raw > 0.99 * ALPHA_CUT), (on_plane / on_screen).log().abs(), math.inf),
            (raw / ALPHA_CUT).log().abs(),
            (raw / ALPHA_CAP).log().abs(),
            (before / MIN_TRANSMITTANCE).log().abs(),
        ]
        margin = torch.where(seen[None], torch.stack(margins), math.inf).amin(dim=0)
        margin = torch.cat([margin, torch.full_like(x, math.inf)[..., None]], dim=-1).amin(dim=-1)
    return *maps, margin
