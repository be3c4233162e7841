"""Normals of surfels, turned towards a camera."""

import ctypes

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from refgs.camera import Camera
from refgs.clock import timed
from refgs.kernels.load import Shared, Work, check, run


class _Work(Work):
    """`struct Normals` of normals.cpp."""

    _fields_ = (
        ("count", ctypes.c_int64),
        *((n, ctypes.c_void_p) for n in ("rotations", "positions")),
        ("camera", ctypes.c_double * 3),
        *((n, ctypes.c_void_p) for n in ("normals", "by_normals", "by_rotations", "scratch")),
        ("shared", Shared),
    )


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
