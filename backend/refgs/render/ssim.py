"""The structural dissimilarity of two images."""

import ctypes

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from refgs.kernels.load import Shared, Work, kernels, parallel


class _Work(Work):
    """`struct Ssim` of ssim.cpp."""

    _fields_ = (
        [(n, ctypes.c_int64) for n in ("height", "width", "channels")]
        + [(n, ctypes.c_void_p) for n in ("image", "target", "by_mean", "by_square", "by_product", "sums")]
        + [("scale", ctypes.c_double), ("by_image", ctypes.c_void_p), ("scratch", ctypes.c_void_p), ("shared", Shared)]
    )


class _Dssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, target):
        image, target = image.contiguous(), target.contiguous()
        height, width, channels = image.shape
        work = _Work(height=height, width=width, channels=channels)
        sums = torch.empty(height, dtype=torch.float64)
        work.attach(image=image, target=target, sums=sums)
        if ctx.needs_input_grad[0]:
            ctx.maps = torch.empty(3, height, width, channels)
            work.attach(**dict(zip(("by_mean", "by_square", "by_product"), ctx.maps, strict=True)))
            ctx.save_for_backward(image, target)
            ctx.work = work
        library = kernels()
        parallel(library.refgs_ssim_forward, work, library.refgs_ssim_scratch_size(width, channels))
        return (1 - sums.sum() / image.numel()).float()

    @staticmethod
    @once_differentiable
    def backward(ctx, by_dssim):
        image, _ = ctx.saved_tensors
        by_image = torch.empty_like(image)
        ctx.work.scale = -float(by_dssim) / image.numel()
        ctx.work.attach(by_image=by_image)
        library = kernels()
        scratch = library.refgs_ssim_scratch_size(*image.shape[1:])
        parallel(library.refgs_ssim_backward, ctx.work, scratch)
        return by_image, None


def dssim(image: Tensor, target: Tensor) -> Tensor:
    """1 − mean SSIM (Wang et al. 2004) of two float32 images (H, W, 3) with values of about [0, 1]; a scalar.

    Each channel by itself, 11×11 Gaussian window with σ 1.5, C1 = 0.01², C2 = 0.03², zeros beyond the border, mean over all
    pixels. The gradient goes to `image` alone.
    """
    if image.shape != target.shape or image.ndim != 3 or image.numel() == 0:
        raise ValueError(
            f"expected two images (H, W, C) of one shape, got {tuple(image.shape)} and {tuple(target.shape)}"
        )
    if {image.dtype, target.dtype} != {torch.float32} or {image.device.type, target.device.type} != {"cpu"}:
        raise ValueError("expected float32 images on the CPU")
    return _Dssim.apply(image, target)
