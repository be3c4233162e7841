"""Compute the normals of surfels, flipped towards a camera, and how much they face it."""

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from refgs.camera import Camera
from refgs.clock import timed
from refgs.kernels.function import Function
from refgs.kernels.layout import struct
from refgs.kernels.load import check, run

_Work = struct("Normals", "normals.cpp")


@timed("surfels")
class _Facing(Function):
    @staticmethod
    def forward(ctx, rotations, positions, camera):
        inputs = {"rotations": rotations.contiguous(), "positions": positions.contiguous()}
        work, normals = _Work(count=len(positions)), torch.empty_like(positions)
        work.camera[:] = camera.position.tolist()
        work.attach(**inputs, normals=normals)
        run("refgs_normals_forward", work, normals, items=work.count)
        ctx.save_for_backward(*inputs.values())
        ctx.work = work
        return normals

    @staticmethod
    @once_differentiable
    def backward(ctx, by_normals):
        by_normals, by_rotations = by_normals.contiguous(), torch.empty_like(ctx.saved_tensors[0])
        ctx.work.attach(by_normals=by_normals, by_rotations=by_rotations)
        run("refgs_normals_backward", ctx.work, by_normals, items=ctx.work.count)
        return by_rotations, None, None


def facing_normals(rotations: Tensor, positions: Tensor, camera: Camera) -> Tensor:
    """Compute the surfels' unit normals (N, 3). Flip those that clearly face away from the camera.

    `rotations` (N, 4) are quaternions wxyz of any length, `positions` (N, 3) are in world space, both float32. Differentiable in
    `rotations` only.

    Normals that face away only slightly are not flipped (kernels/normals.cpp has the limit). On a closed surface, these surfels lie just
    beyond the silhouette, where they are still partly visible. Flipping them would make the blended normals noisy there.
    """
    check(rotations=(rotations, (len(positions), 4)), positions=(positions, (len(positions), 3)))
    return _Facing.apply(rotations, positions.detach(), camera)


def facing_cosine(positions: Tensor, normals: Tensor, camera: Camera) -> Tensor:
    """Compute the cosine (N,) between each surfel's unit normal and its direction to the camera."""
    towards = torch.from_numpy(camera.position).to(positions) - positions
    return (torch.nn.functional.normalize(towards, dim=-1) * normals).sum(dim=-1)
