"""Draw 3D Gaussians with the rasteriser of surfels, for comparison (Ref-Gaussian paper, Tables 3 and 7).

Each 3D Gaussian is replaced by a disc that looks the same to the camera. EWA splatting (Zwicker et al. 2001, as in Kerbl et al. 2023) gives
the ellipse that the Gaussian covers in the picture. The disc covers the same ellipse. It lies at the depth of the Gaussian's centre, at
right angles to the camera's axis. The rasteriser draws such discs exactly.
"""

from typing import cast

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.autograd.function import once_differentiable

from refgs.camera import Camera
from refgs.clock import timed
from refgs.kernels.function import Function
from refgs.model.surfels import Surfels, axes

SIDE = 1.3  # half pictures from the centre; the projection's derivative, which grows without bound, is clamped there
# Quaternions wxyz of the rotations that move axis 0, 1 or 2 to the third place.
TO_THIRD = ((0.5, 0.5, 0.5, 0.5), (0.5, -0.5, -0.5, -0.5), (1.0, 0.0, 0.0, 0.0))


def product(a: Tensor, b: Tensor) -> Tensor:
    """Multiply quaternions wxyz (..., 4). The product rotates by b first, then by a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


def shortest_last(rotations: Tensor, scales: Tensor) -> tuple[Tensor, Tensor]:
    """Reorder 3D Gaussians' axes so that the shortest, which is the normal, comes third."""
    shortest = scales.argmin(dim=1)
    turns = rotations.new_tensor(TO_THIRD)[shortest]
    order = (shortest[:, None] + torch.arange(1, 4, device=scales.device)) % 3
    return product(rotations, turns), scales.gather(1, order)


def with_normals_last(surfels: Surfels) -> Surfels:
    """Make 3D Gaussians' normals the third axis; return surfels unchanged."""
    if surfels.scales.shape[1] == 2:
        return surfels
    rotations, scales = shortest_last(surfels.rotations, surfels.scales)
    return surfels._replace(rotations=rotations, scales=scales)


@timed("surfels")
class _HalfAngle(Function):
    """Compute atan2(y, x) / 2, with a derivative that fades to 0 near the origin."""

    @staticmethod
    def forward(ctx, y, x, size):
        ctx.save_for_backward(y, x, size)
        return 0.5 * torch.atan2(y, x)

    @staticmethod
    @once_differentiable
    def backward(ctx, by_angle):
        y, x, size = ctx.saved_tensors
        scaled = 0.5 * by_angle / (x * x + y * y + (1e-4 * size) ** 2)
        return scaled * x, -scaled * y, None


def discs(surfels: Surfels, camera: Camera) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return `rasterize`'s first four arguments, with 3D Gaussians as discs that look the same."""
    positions, rotations, scales, opacities, *_ = surfels
    if scales.shape[1] == 3:
        rotations, scales = across_the_axis(positions, rotations, scales, camera)
    return positions, rotations, scales, opacities


def across_the_axis(positions: Tensor, rotations: Tensor, scales: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Replace 3D Gaussians by flat discs that look the same to this camera. The discs lie at right angles to the camera's axis.

    Takes `positions` (N, 3), `rotations` (N, 4) of any length and `scales` (N, 3). Returns the discs' rotations (N, 4), quaternions wxyz,
    and scales (N, 2), standard deviations in world units. Differentiable in all three arguments.
    """
    columns = [axis.unbind(-1) for axis in axes(rotations)]
    view = camera.world_to_camera.tolist()
    point = [sum(view[i][j] * positions[:, j] for j in range(3)) + view[i][3] for i in range(3)]
    depth = point[2].clamp_min(1e-9)
    wide, high = (
        max(camera.cx, camera.width - camera.cx) / camera.fx,
        max(camera.cy, camera.height - camera.cy) / camera.fy,
    )
    slope = [(p / depth).clamp(-SIDE * most, SIDE * most) for p, most in zip(point, (wide, high), strict=False)]
    # The three axes projected to the camera's plane: the projection's derivative, times the depth.
    moves = []
    for column, scale in zip(columns, scales.unbind(-1), strict=True):
        a = [scale * sum(view[i][j] * column[j] for j in range(3)) for i in range(3)]
        moves.append((a[0] - slope[0] * a[2], a[1] - slope[1] * a[2]))
    xx, xy, yy = (cast(Tensor, sum(m[i] * m[j] for m in moves)) for i, j in ((0, 0), (0, 1), (1, 1)))
    middle, apart = (xx + yy) / 2, (xx - yy) / 2
    half = torch.sqrt(apart * apart + xy * xy + 1e-12 * middle * middle)
    variances = torch.stack([middle + half, (middle - half).clamp_min(1e-9 * middle.detach())], dim=-1)
    angle = _HalfAngle.apply(xy, apart, middle.detach()) / 2
    none = torch.zeros_like(angle)
    turn = torch.stack([torch.cos(angle), none, none, torch.sin(angle)], dim=-1)
    return product(_from_camera(camera).to(turn), turn), torch.sqrt(variances + 1e-30)


def _from_camera(camera: Camera) -> Tensor:
    """Return the rotation from camera space to world space as a quaternion wxyz (4,)."""
    x, y, z, w = Rotation.from_matrix(camera.world_to_camera[:3, :3].T).as_quat()
    return torch.tensor([w, x, y, z])
