"""Compute the training loss (Ref-Gaussian paper, §3.3): colour, normal consistency, edge-aware smoothness, and further terms."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from refgs.clock import timed
from refgs.kernels import cuda, load
from refgs.kernels.function import Function
from refgs.kernels.layout import struct
from refgs.kernels.load import check, run
from refgs.render.renderer import Rendering
from refgs.render.ssim import dssim
from refgs.settings import LossSettings
from refgs.train.photo import Photo

TILE = 32, 8  # width and height, in pixels, of a block of losses.cpp on CUDA
ROUND_OFF = 0.02
SUMS = 3  # sums of each row or block: loss, pixels with a surface, squared errors


class Objective(NamedTuple):
    """Hold the training loss of one view, and the mean squared error of its picture.

    `loss` is a differentiable scalar. `square` is the mean squared error between the picture and the photo, both clipped to 0..1. If the
    photo is a crop, errors are averaged over the whole photo, as if pixels outside the crop had no error.
    """

    loss: Tensor
    square: Tensor


_Work = struct("Losses", "losses.cpp")


@timed("loss")
class _Objective(Function):
    """Compute the training loss and its derivatives together, as an autograd function."""

    DIFFERENTIABLE = "color", "normal", "depth", "alpha", "material", "light"

    @staticmethod
    def forward(ctx, color, normal, depth, alpha, material, light, photo, background, weights, progress):
        camera, (height, width) = photo.camera, alpha.shape
        inputs = {"color": color, "normal": normal, "depth": depth, "alpha": alpha}
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(inputs, (height, width))
        shapes |= {"color": (height, width, 3), "normal": (height, width, 3), "background": (3,)}
        inputs["background"] = background
        if material is not None:
            inputs["material"], shapes["material"] = material, (height, width, 5)
        if light is not None:
            inputs["light"], shapes["light"] = light, (3,)
        check(**{name: (value, shapes[name]) for name, value in inputs.items()})
        inputs = {name: value.contiguous() for name, value in inputs.items()}
        color = inputs["color"]
        codes = {"fine" if photo.image.dtype == torch.uint16 else "image": photo.image}
        codes |= {} if photo.mask is None else {"mask": photo.mask}
        for name, value in codes.items():
            kept = value.dtype == (torch.uint16 if name == "fine" else torch.uint8)
            if value.shape[:2] != alpha.shape or not kept or value.device != color.device:
                raise ValueError(
                    f"{camera.name}: the photo and its mask must be uint8 on {color.device}, of the rendering's size, "
                    f"{width}×{height} (the photo also uint16); got {value.dtype} {tuple(value.shape)} on {value.device}"
                )
        gradients = {name: torch.empty_like(value) for name, value in inputs.items() if name != "background"}
        buffers = {"photo": torch.empty_like(color), "clipped": torch.empty_like(color)}
        buffers["slopes"] = color.new_empty(4, height, width)
        blocks = -(-width // TILE[0]) * -(-height // TILE[1])
        sums = color.new_empty(2, blocks if load.on_gpu(color) else height, SUMS, dtype=torch.float64)

        work = _Work(width=width, height=height, white=photo.white, largest=torch.iinfo(photo.image.dtype).max)
        work.rotation[:] = camera.world_to_camera[:3, :3].reshape(-1).tolist()
        work.across, work.left = 1 / camera.fx, (0.5 - camera.cx) / camera.fx
        work.down, work.top = 1 / camera.fy, (0.5 - camera.cy) / camera.fy
        rows, columns = photo.whole or alpha.shape
        pixels, across, down = rows * columns, max(rows * (columns - 1), 1), max((rows - 1) * columns, 1)
        structure_weight = weights.dssim * alpha.numel() / pixels
        work.color_weight = (1 - weights.dssim) / (3 * pixels)
        work.normal_weight = weights.normal / max((rows - 2) * (columns - 2), 1)
        work.smooth_x_weight, work.smooth_y_weight = weights.smooth / across, weights.smooth / down
        if material is not None:
            work.even_x_weight, work.even_y_weight = weights.even / across, weights.even / down
        work.alpha_weight = weights.alpha / pixels
        work.metallic_weight, work.matte_weight = weights.metallic * progress**2, weights.matte
        work.dssim_weight, work.light_weight = structure_weight, weights.light
        by = {f"by_{name}": value for name, value in gradients.items()}
        work.attach(**inputs, **codes, **by, **buffers, sums=sums[0])
        run("refgs_losses_first", work, color, items=blocks * cuda.BLOCK)

        totals = [sums[0].sum(dim=0)]
        if weights.dssim > 0:
            structure, by_clipped = dssim(buffers["clipped"], buffers["photo"], structure_weight)
        else:
            structure, by_clipped = None, torch.zeros_like(color)
        work.attach(by_clipped=by_clipped, first=totals[0], sums=sums[1])
        run("refgs_losses_second", work, color, items=blocks * cuda.BLOCK)

        totals.append(sums[1].sum(dim=0))
        loss, square = color.new_empty(()), color.new_empty(())
        work.attach(second=totals[1], loss=loss, square=square)
        if structure is not None:
            work.attach(structure=structure)
        run("refgs_losses_total", work, color, items=1)
        ctx.gradients = [gradients.get(name) for name in _Objective.DIFFERENTIABLE]
        square *= alpha.numel() / pixels
        ctx.mark_non_differentiable(square)
        return loss, square

    @staticmethod
    @once_differentiable
    def backward(ctx, by_loss, _):
        # Nearly always true; on a graphics card, reading the value would wait.
        one = not load.on_gpu(by_loss) and by_loss == 1
        scaled = ctx.gradients if one else [None if g is None else by_loss * g for g in ctx.gradients]
        return *scaled, None, None, None, None


def departure(exposure: Tensor) -> Tensor:
    """Compute a loss that keeps a photo's exposure near one. `exposure` (K,) are its learned weights (see `exposures.exposure`).

    Without this loss, a brighter light with shorter exposures would fit the photos as well. The loss is the sum of the weights' absolute
    values, smoothed near zero. Absolute values, unlike squares, let a few photos differ strongly without moving the others.
    """
    return (torch.sqrt(exposure * exposure + ROUND_OFF**2) - ROUND_OFF).sum()


def objective(
    rendering: Rendering,
    light: Tensor | None,
    photo: Photo,
    background: Tensor,
    weights: LossSettings,
    progress: float,
) -> Objective:
    """Compute the training loss of one view. `progress` is 0 at the start of the training and 1 at its end.

    The loss is the sum of these terms, each with a weight in `weights`:

    - Colour: (1 − λ) L1 + λ D-SSIM of sRGB pictures. The photo is composited over `background`. Where a channel of the photo is clipped
      and the mask is at least one half, the scene may be brighter: a brighter rendering has neither loss nor gradient. Elsewhere the
      rendering is not clipped, so that pixels that are too bright have a gradient.
    - Normals: 1 − ÑᵀN where the surface is opaque around the pixel. N is the rendered normal. Ñ is the normal of the depth map, by central
      differences.
    - Smoothness: ‖∇N‖ exp(−‖∇C‖) where the surface is opaque. C is the photo's colour, and ∇ takes forward differences. Metallic and
      roughness are smoothed with a weight of their own, because photos do not determine them where the mirrored light is uniform.
    - Mask: |α − mask|.
    - Light: how far `light` (3,), the mean radiance that the object mirrors, is from grey: mean((light / mean(light) − 1)²). Without this
      term, white balance drifts, because warm metal under neutral light looks almost like neutral metal under warm light.
    - Metallic m: m (1 − m), because real surfaces are either metal or not. The weight grows with the square of `progress`, because early in
      the training it is unknown which surfaces are metal.
    - Roughness: how much it exceeds 0.3. Without this term, it would grow where photos are clipped or show nothing bright: a blurred
      reflection fits there as well as a sharp one, even if normals are wrong.
    """
    material = rendering.material if max(weights.metallic, weights.even, weights.matte) > 0 else None
    maps = rendering.color, rendering.normal, rendering.blended_depth, rendering.alpha, material
    return Objective(*_Objective.apply(*maps, light, photo, background, weights, progress))
