"""Compute the structural dissimilarity of two images."""

import torch
from torch import Tensor

from refgs.kernels import cuda, load
from refgs.kernels.layout import struct
from refgs.kernels.load import check, kernels, run

TILE = 224, 6  # floats of a row, and rows, of a CUDA block in ssim.cpp


_Work = struct("Ssim", "ssim.cpp")


@torch.no_grad()
def dssim(image: Tensor, target: Tensor, weight: float = 1.0) -> tuple[Tensor, Tensor]:
    """Compute the structural dissimilarity 1 − mean SSIM (Wang et al. 2004) of two images. Also returns its gradient times `weight`.

    The images are float32 (H, W, 3), in about [0, 1]; ValueError is raised for other shapes. The gradient (H, W, 3) is with respect to
    `image`. SSIM uses an 11×11 Gaussian window with σ = 1.5, C1 = 0.01², C2 = 0.03², and zeros outside the image. It is computed for each
    channel, and its mean is over all pixels and channels.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.numel() == 0:
        raise ValueError(f"expected images (H, W, 3), got {tuple(image.shape)}")
    check(image=(image, image.shape), target=(target, image.shape))
    inputs = {"image": image.contiguous(), "target": target.contiguous()}
    height, width, _ = image.shape
    blocks = -(-3 * width // TILE[0]) * -(-height // TILE[1])
    sums = image.new_empty(blocks if load.on_gpu(image) else height, dtype=torch.float64)
    maps, by_image = image.new_empty(3, *image.shape), torch.empty_like(inputs["image"])
    work = _Work(height=height, width=width, scale=-weight / image.numel())
    work.attach(**inputs, sums=sums, by_image=by_image)
    work.attach(**dict(zip(("by_mean", "by_square", "by_product"), maps, strict=True)))
    scratch = 0 if load.on_gpu(image) else kernels().refgs_ssim_scratch_size(width)
    for name in ("refgs_ssim_forward", "refgs_ssim_backward"):
        run(name, work, image, items=blocks * cuda.BLOCK, scratch=scratch)
    return (1 - sums.sum() / image.numel()).float(), by_image
