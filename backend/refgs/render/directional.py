"""Evaluate the view-dependent colours of surfels."""

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from refgs.camera import Camera
from refgs.clock import timed
from refgs.kernels.function import Function
from refgs.kernels.layout import struct
from refgs.kernels.load import run

_Work = struct("Harmonics", "harmonics.cpp")


@timed("surfels")
class _Directional(Function):
    @staticmethod
    def forward(ctx, constant, rest, offset, positions, normals, camera):
        inputs = {"constant": constant.contiguous(), "rest": rest.contiguous(), "positions": positions.contiguous()}
        if normals is not None:
            inputs["normals"] = normals.contiguous()
        work = _Work(count=len(positions), coefficients=1 + rest.shape[1], offset=offset)
        work.camera[:] = camera.position.tolist()
        color = torch.empty_like(inputs["positions"])
        work.attach(**inputs, color=color)
        run("refgs_harmonics_forward", work, color, items=work.count)
        ctx.save_for_backward(*inputs.values(), color)
        ctx.work = work
        return color

    @staticmethod
    @once_differentiable
    def backward(ctx, by_color):
        by_color, (constant, rest, *_) = by_color.contiguous(), ctx.saved_tensors
        by_constant, by_rest = torch.empty_like(constant), torch.empty_like(rest)
        ctx.work.attach(by_color=by_color, by_constant=by_constant, by_rest=by_rest)
        run("refgs_harmonics_backward", ctx.work, by_color, items=ctx.work.count)
        return by_constant, by_rest, None, None, None, None


def directional(
    constant: Tensor, rest: Tensor, offset: float, positions: Tensor, camera: Camera, normals: Tensor | None = None
) -> Tensor:
    """Evaluate spherical harmonics as colours of surfels seen by a camera: (N, 3) = max(0, offset + Σ_k c_k Y_k(d)).

    The coefficients c_k are `constant` (N, 1, 3), then `rest` (N, K − 1, 3), in the order of `refgs.model.harmonics`; K = (degree + 1)².
    The direction d points from the camera to the surfel at `positions` (N, 3). If unit `normals` (N, 3) are given, d is this direction
    reflected at the surfel (Ref-Gaussian paper, Eq. 10). All are float32. Differentiable in `constant` and `rest` only. Raises ValueError
    for coefficients of other shapes.
    """
    count = len(positions)
    if constant.shape != (count, 1, 3) or rest.shape not in [(count, k - 1, 3) for k in (1, 4, 9, 16)]:
        found = f"{tuple(constant.shape)} and {tuple(rest.shape)}"
        raise ValueError(f"expected harmonics of {count} surfels, got {found}")
    return _Directional.apply(
        constant, rest, offset, positions.detach(), None if normals is None else normals.detach(), camera
    )
