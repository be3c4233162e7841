"""Rasterise surfels into maps of features, depth and alpha. Differentiable."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from refgs.camera import Camera
from refgs.clock import timed
from refgs.kernels import load
from refgs.kernels.function import Function
from refgs.render import raster_cpu, raster_cuda
from refgs.render.raster import Scene


class Raster(NamedTuple):
    """Hold the maps that the rasteriser returns. Each pixel is a weighted sum over its surfels.

    The weight of a surfel is w = α Π (1 − α'), where α' are the alphas of the surfels in front of it (Ref-Gaussian paper, Eq. 5). No
    background is added.

    - `features` (H, W, C): Σ w · feature. Divide by `alpha` for the mean.
    - `depth` (H, W): Σ w · depth. Divide by `alpha` for the mean. Depth is along the camera's axis, at the point where the ray meets the
      surfel (Ref-Gaussian paper, Eq. 4). Where the surfel's alpha comes from the low-pass filter, the centre's depth is used instead.
    - `alpha` (H, W): Σ w.
    """

    features: Tensor
    depth: Tensor
    alpha: Tensor


def _draw(splats: dict[str, Tensor], camera: Camera, near: float, *trim: float) -> tuple[Scene, Raster]:
    """Rasterise tensors named as `rasterize`'s arguments; return the kernels' arguments and the maps."""
    features = splats["features"]
    rasteriser = raster_cuda if load.on_gpu(features) else raster_cpu
    work = rasteriser.Raster(splats=features.shape[0], channels=features.shape[1])
    work.attach(**splats)
    work.look(camera, near, *trim)
    work.project(features.device)
    maps = Raster(
        features.new_empty(camera.height, camera.width, features.shape[1]),
        features.new_empty(camera.height, camera.width),
        features.new_empty(camera.height, camera.width),
    )
    work.attach(**{f"out_{name}": map for name, map in maps._asdict().items()})
    work.blend()
    return work, maps


@timed("raster")
class _Rasterize(Function):
    @staticmethod
    def forward(ctx, positions, rotations, scales, opacities, features, camera, near):
        inputs = {
            "positions": positions.contiguous(),
            "rotations": rotations.contiguous(),
            "scales": scales.contiguous(),
            "opacities": opacities.contiguous(),
            "features": features.contiguous(),
        }
        work, maps = _draw(inputs, camera, near)
        ctx.save_for_backward(*inputs.values(), *maps)
        ctx.work = work
        return tuple(maps)

    @staticmethod
    @once_differentiable
    def backward(ctx, by_features, by_depth, by_alpha):
        work, saved = (
            ctx.work,
            ctx.saved_tensors,
        )  # reading saved_tensors also checks that nothing changed them in place
        upstream = {
            "by_features": by_features.contiguous(),
            "by_depth": by_depth.contiguous(),
            "by_alpha": by_alpha.contiguous(),
        }
        gradients = {
            "by_positions": torch.empty_like(saved[0]),
            "by_rotations": torch.empty_like(saved[1]),
            "by_scales": torch.empty_like(saved[2]),
            "by_opacities": torch.empty_like(saved[3]),
            "by_splat_features": torch.empty_like(saved[4]),
        }
        work.attach(**upstream, **gradients)
        work.differentiate()
        return *gradients.values(), None, None


def rasterize(
    positions: Tensor,
    rotations: Tensor,
    scales: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: Camera,
    near: float,
) -> Raster:
    """Blend surfels into maps, front to back. The surfels are sorted by the depths of their centres.

    - `positions` (N, 3): centres, in world space
    - `rotations` (N, 4): quaternions wxyz of any length
    - `scales` (N, 2): standard deviations along the surfel's two axes, in world units
    - `opacities` (N,): in 0..1
    - `features` (N, C): the values to blend
    - `near`: the smallest depth that is drawn, in world units, > 0. It applies to centres and to intersections with rays.

    All tensors are float32, on the CPU or on one CUDA card, and differentiable.

    Alpha below 1/255 is skipped, and alpha is at most 0.99. A pixel is finished when its transmittance falls below 1e-4. The low-pass
    filter has σ = √2/4 pixels, half of 2DGS's. (kernels/splat.h has these constants.) Results do not depend on the number of threads. A
    card returns the same bits each time.
    """
    n, channels = features.shape[0], features.shape[1:2]
    load.check(
        positions=(positions, (n, 3)),
        rotations=(rotations, (n, 4)),
        scales=(scales, (n, 2)),
        opacities=(opacities, (n,)),
        features=(features, (n, *channels)),
    )
    if max(camera.width, camera.height) > 16383:
        raise ValueError(f"images are at most 16,383 pixels wide and high, not {camera.width}×{camera.height}")
    if near <= 0:
        raise ValueError(f"near must be positive, got {near}")
    # A card's kernels hold a pixel's channels in registers: draw as many at a time as fit.
    parts = features.split(raster_cuda.MOST, dim=1) if load.on_gpu(features) else [features]
    maps = [_Rasterize.apply(positions, rotations, scales, opacities, part, camera, near) for part in parts]
    joined = maps[0][0] if len(maps) == 1 else torch.cat([features for features, *_ in maps], dim=-1)
    return Raster(joined, *maps[0][1:])


@torch.no_grad()
def trimmed_depth(
    positions: Tensor,
    rotations: Tensor,
    scales: Tensor,
    opacities: Tensor,
    camera: Camera,
    near: float,
    upper: float,
    lower: float,
) -> tuple[Tensor, Tensor]:
    """Compute the depth (H, W) of the surface along the camera's axis, and alpha (H, W). Not differentiable.

    The depth is a weighted mean over some surfels of the pixel: those that lower the ray's transmittance from `upper` to `lower` (1 ≥ upper
    > lower ≥ 0). So neither faint surfels in front of the surface nor surfels behind it count. The depth is 0 where the transmittance stays
    above `upper`. With limits close to 0.5, it is nearly the median depth, which 2DGS uses for unbounded scenes.

    The other arguments are those of `rasterize`.
    """
    splats = {"positions": positions, "rotations": rotations, "scales": scales, "opacities": opacities}
    splats = {name: value.contiguous() for name, value in splats.items()} | {
        "features": opacities.new_zeros(len(opacities), 1)
    }
    _, (_, depth, alpha) = _draw(splats, camera, near, upper, lower)
    part = upper - (1 - alpha).clamp(lower, upper)
    return torch.where(part > 0, depth / part.clamp_min(1e-6), 0), alpha
