"""Colour by direction, of surfels."""

import ctypes

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from refgs.camera import Camera
from refgs.kernels.load import Shared, Work, run


class _Work(Work):
    """`struct Harmonics` of harmonics.cpp."""

    _fields_ = (
        [(n, ctypes.c_int64) for n in ("count", "coefficients")]
        + [(n, ctypes.c_void_p) for n in ("values", "positions", "normals")]
        + [("camera", ctypes.c_double * 3), ("offset", ctypes.c_float)]
        + [(n, ctypes.c_void_p) for n in ("color", "by_color", "by_values", "scratch")]
        + [("shared", Shared)]
    )


class _Directional(torch.autograd.Function):
    @staticmethod
    def forward(ctx, coefficients, offset, positions, normals, camera):
        inputs = {"values": coefficients.contiguous(), "positions": positions.contiguous()}
        if normals is not None:
            inputs["normals"] = normals.contiguous()
        work = _Work(count=coefficients.shape[0], coefficients=coefficients.shape[1], offset=offset)
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
        by_color, by_values = by_color.contiguous(), torch.empty_like(ctx.saved_tensors[0])
        ctx.work.attach(by_color=by_color, by_values=by_values)
        run("refgs_harmonics_backward", ctx.work, by_color, items=ctx.work.count)
        return by_values, None, None, None, None


def directional(
    coefficients: Tensor, offset: float, positions: Tensor, camera: Camera, normals: Tensor | None = None
) -> Tensor:
    """Colour (N, 3) = max(0, offset + Σ_k c_k Y_k(d)) of surfels at `positions` (N, 3), from `coefficients` (N, K, 3) of
    the harmonics in `refgs.model.harmonics`, K = (degree + 1)². d is the direction from the camera; with unit `normals`
    (N, 3), it mirrored at the surfel (paper Eq. 10). float32; differentiable in the coefficients alone.
    """
    if coefficients.shape not in [(len(positions), k, 3) for k in (1, 4, 9, 16)]:
        raise ValueError(f"expected harmonics of {len(positions)} surfels, got {tuple(coefficients.shape)}")
    return _Directional.apply(
        coefficients, offset, positions.detach(), None if normals is None else normals.detach(), camera
    )
