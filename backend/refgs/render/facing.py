"""Turn the normals of surfels towards a camera."""

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from refgs.camera import Camera
from refgs.clock import timed
from refgs.kernels.layout import struct
from refgs.kernels.load import check, run

_Work = struct("Normals", "normals.cpp")


@timed("surfels")
class _Facing(torch.autograd.Function):
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
    """Compute unit normals (N, 3) and turn those that clearly face away from the camera.

    Takes quaternions wxyz (N, 4) of any length and positions (N, 3), float32; differentiable in the rotations alone.

    Normals that face away only slightly stay. On a closed surface they lie just past the horizon and show at the silhouette; turning
    them would scatter the blended normal. normals.cpp has the angle.
    """
    check(rotations=(rotations, (len(positions), 4)), positions=(positions, (len(positions), 3)))
    return _Facing.apply(rotations, positions.detach(), camera)
