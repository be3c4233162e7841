"""The objective (paper §3.3): colour, normal consistency, edge-aware smoothness; and the mask."""

import ctypes
import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from refgs.capture import LoadedView
from refgs.kernels.load import Shared, Work, check, kernels, parallel
from refgs.model.environment import Environment
from refgs.render.renderer import Rendering
from refgs.render.ssim import dssim
from refgs.settings import LossSettings


class Objective(NamedTuple):
    """The training loss of a view, a differentiable scalar, and its peak signal-to-noise ratio in dB, clipped to 0..1."""

    loss: Tensor
    psnr: float


class _Work(Work):
    """`struct Losses` of losses.cpp."""

    _fields_ = (
        [(n, ctypes.c_int64) for n in ("width", "height")]
        + [(n, ctypes.c_void_p) for n in ("color", "normal", "depth", "alpha", "material", "image", "mask")]
        + [("background", ctypes.c_float * 3), ("rotation", ctypes.c_double * 9)]
        + [(n, ctypes.c_double) for n in ("fx", "fy", "cx", "cy")]
        + [(f"{n}_weight", ctypes.c_float) for n in ("color", "normal", "smooth_x", "smooth_y", "alpha", "metallic")]
        + [(n, ctypes.c_void_p) for n in ("photo", "clipped", "by_clipped")]
        + [(n, ctypes.c_void_p) for n in ("by_color", "by_normal", "by_depth", "by_alpha", "by_material", "slopes")]
        + [(n, ctypes.c_void_p) for n in ("sums", "scratch")]
        + [("shared", Shared)]
    )


class _Maps(torch.autograd.Function):
    """The terms that a rendering's maps say, but the light's; the derivatives are had with the value."""

    @staticmethod
    def forward(ctx, color, normal, depth, alpha, material, view, background, weights, progress):
        library, camera, (height, width) = kernels(), view.camera, alpha.shape
        inputs = {"color": color, "normal": normal, "depth": depth, "alpha": alpha}
        if material is not None:
            inputs["material"] = material
        numbers = {"color": (3,), "normal": (3,), "material": (5,)}
        check(**{name: (value, (height, width, *numbers.get(name, ()))) for name, value in inputs.items()})
        if {view.image.shape[:2], (view.image if view.alpha is None else view.alpha).shape[:2]} != {alpha.shape}:
            raise ValueError(f"{camera.name}: the photo and its mask must be of the rendering's size, {width}×{height}")
        inputs = {name: value.contiguous() for name, value in inputs.items()}
        color = inputs["color"]
        gradients = {f"by_{name}": torch.empty_like(value) for name, value in inputs.items()}
        buffers = {"photo": torch.empty_like(color), "clipped": torch.empty_like(color)}
        buffers["slopes"] = torch.empty(4, height, width)
        buffers["sums"] = sums = torch.zeros(height, library.refgs_losses_sums(), dtype=torch.float64)
        buffers["image"] = torch.from_numpy(view.image)
        if view.alpha is not None:
            buffers["mask"] = torch.from_numpy(view.alpha)

        work = _Work(width=width, height=height, fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy)
        work.background[:] = background.tolist()
        work.rotation[:] = camera.world_to_camera[:3, :3].reshape(-1).tolist()
        work.color_weight = (1 - weights.dssim) / color.numel()
        work.normal_weight = weights.normal / max((height - 2) * (width - 2), 1)
        work.smooth_x_weight = weights.smooth / max(height * (width - 1), 1)
        work.smooth_y_weight = weights.smooth / max((height - 1) * width, 1)
        work.alpha_weight = weights.alpha / alpha.numel()
        work.attach(**inputs, **gradients, **buffers)
        parallel(library.refgs_losses_first, work)

        structure = torch.zeros(())
        if weights.dssim > 0:
            with torch.enable_grad():
                clipped = buffers["clipped"].requires_grad_()
                structure = dssim(clipped, buffers["photo"])
                (by_clipped,) = torch.autograd.grad(structure, clipped, torch.tensor(weights.dssim))
        else:
            by_clipped = torch.zeros_like(color)
        metallic, covered, squares = sums[:, 1:].sum(dim=0).tolist()
        work.metallic_weight = weights.metallic * progress**2 / max(covered, 1)
        work.attach(by_clipped=by_clipped)
        parallel(library.refgs_losses_second, work)
        ctx.gradients = list(gradients.values()) + [None] * (material is None)
        psnr = -10 * math.log10(max(squares / color.numel(), 1e-10))
        value = float(sums[:, 0].sum()) + work.metallic_weight * metallic + weights.dssim * float(structure)
        return torch.tensor(value), psnr

    @staticmethod
    @once_differentiable
    def backward(ctx, by_loss, _):
        scaled = ctx.gradients if by_loss == 1 else [None if g is None else by_loss * g for g in ctx.gradients]
        return *scaled, None, None, None, None


def light_loss(environment: Environment) -> Tensor:
    """Squared departure from grey of the mean over all directions.

    Warm metal under a neutral light and neutral metal under a warm light look almost alike; without a word for one of
    them, white balance drifts between the two. Only the mean is held: the light's colours may differ by direction.
    """
    mean = environment.irradiance[0]  # the constant harmonic
    return ((mean / mean.mean().clamp_min(1e-9) - 1) ** 2).mean()


def objective(
    rendering: Rendering,
    environment: Environment | None,
    view: LoadedView,
    background: Tensor,
    weights: LossSettings,
    progress: float,
) -> Objective:
    """What training lowers, of one view, at a progress of 0..1.

    Colour: (1 − λ) L1 + λ D-SSIM on sRGB, against the photo over the background. The rendering is clipped only where the
    photo is: elsewhere an over-bright pixel must feel its gradient. Normals: 1 − ÑᵀN, Ñ from the depth by central
    differences, where the surface is opaque around the pixel. Smoothness: ‖∇N‖ exp(−‖∇C_gt‖), forward differences, where
    the surface is opaque. The mask: |α − mask|.

    And m (1 − m) of the metallic m, over the object: nothing real is half a metal. Where the metallic is decided, the
    highlights of dielectrics, 4 % of the light and without colour, fix the light's scale and white balance, which metals
    alone cannot. Not before it is known which is which, hence with the square of the progress.
    """
    material = rendering.material if weights.metallic > 0 else None
    maps = rendering.color, rendering.normal, rendering.blended_depth, rendering.alpha, material
    loss, psnr = _Maps.apply(*maps, view, background, weights, progress)
    if environment is not None and weights.light > 0:
        loss = loss + weights.light * light_loss(environment)
    return Objective(loss, psnr)
