"""Kernels in float32 against the float64 reference: the largest error of values and gradients, each by its tensor's largest value."""

from collections.abc import Sequence

import torch
from torch import Tensor

from benchmarks.stability.cases import Found
from refgs.camera import Camera
from refgs.kernels import reference
from refgs.model.environment import Environment
from refgs.render.rasterize import rasterize
from refgs.render.shade import shade

MARGIN = 1e-4  # pixels nearer to a decision that rounding could turn are left out
SMOOTH = 2e-5  # the same of kinks in derivatives: values have none
SAFE = 0.5  # of the picture, or of what is drawn of it, at the least, must be left
FLOAT32 = "float32, sums of hundreds of terms"


class Undecided(Exception):
    """Too much of a picture hangs on comparisons that rounding can turn."""


def worst(found: Sequence[Tensor], expected: Sequence[Tensor], floor: float = 1e-30) -> float:
    """The largest error of pairs of tensors, by the largest value of each. What is expected to be nothing has an error by itself."""
    errors = [0.0]
    for value, exact in zip(found, expected, strict=True):
        if exact.numel():
            error, size = (value.double() - exact).abs().max(), exact.abs().max()
            errors.append(float(error / size if size > floor else error))
    return max(errors)


def outcome(
    found: Sequence[Tensor], expected: Sequence[Tensor], by: Sequence[Tensor], exact_by: Sequence[Tensor]
) -> Found:
    """Of values and gradients; a gradient's error counts a tenth."""
    finite = all(bool(v.isfinite().all()) for v in (*found, *by))
    return Found(finite, max(worst(found, expected), 0.1 * worst(by, exact_by)))


def raster(inputs: Sequence[Tensor], camera: Camera, near: float = 0.1, nearest: int | None = None) -> Found:
    """The rasteriser forward and backward. Of many surfels the reference may take the `nearest`, where these hide the rest."""
    few = inputs if nearest is None else _nearest(inputs, camera, nearest)
    exact = [v.double().requires_grad_() for v in few]
    *maps, margin = reference.rasterize(*exact, camera, near)
    safe, drawn = margin > MARGIN, maps[2] > 0
    if drawn.any() and safe[drawn].float().mean() < SAFE:
        raise Undecided(f"only {float(safe[drawn].float().mean()):.0%} of what is drawn can be compared")
    generator = torch.Generator().manual_seed(1)
    upstream = [
        torch.randn(m.shape, generator=generator) * safe.reshape(safe.shape + (1,) * (m.ndim - 2)) for m in maps
    ]
    exact_by = torch.autograd.grad(maps, exact, [u.double() for u in upstream])
    leaves = [v.clone().requires_grad_() for v in inputs]
    found = rasterize(*leaves, camera, near)
    by = torch.autograd.grad(found, leaves, upstream)
    if nearest is not None:
        kept = _order(inputs, camera)[:nearest]
        hidden = [g[_order(inputs, camera)[nearest:]] for g in by]
        exact_by = [*exact_by, *(torch.zeros_like(g).double() for g in hidden)]
        by = [*(g[kept] for g in by), *hidden]
    return outcome([m.detach()[safe] for m in found], [m.detach()[safe] for m in maps], by, exact_by)


def _order(inputs: Sequence[Tensor], camera: Camera) -> Tensor:
    depth = inputs[0].double() @ torch.from_numpy(camera.world_to_camera[2, :3]) + camera.world_to_camera[2, 3]
    return torch.argsort(depth.float(), stable=True)


def _nearest(inputs: Sequence[Tensor], camera: Camera, count: int) -> list[Tensor]:
    kept = _order(inputs, camera)[:count]
    return [v[kept] for v in inputs]


def shading(features: Tensor, alpha: Tensor, radiance: Tensor, camera: Camera, kink: bool = False) -> Found:
    """Deferred shading forward and backward: of maps as `shade` takes them, under a light (6·R², 3). Where all of the picture lies on a
    `kink`, gradients have to be finite, no more."""
    light = Environment(radiance)
    light.levels = light.levels.requires_grad_()
    background = torch.tensor([0.2, 0.5, 1.0])
    leaves = [features.clone().requires_grad_(), alpha.clone().requires_grad_(), light.levels]
    exact = [v.detach().double().requires_grad_() for v in leaves]
    *maps, margin = reference.shade(*exact, light.sides, camera, background.double())
    safe = margin > SMOOTH
    if not kink and safe.float().mean() < SAFE:
        raise Undecided(f"only {float(safe.float().mean()):.0%} of the picture can be compared")
    generator = torch.Generator().manual_seed(1)
    upstream = [torch.randn(m.shape, generator=generator) * (safe | kink)[..., None] for m in maps[:3]]
    found = shade(*leaves[:2], light, camera, background)
    by = torch.autograd.grad(found[:3], leaves, upstream)
    exact_by = (
        [g.double() for g in by] if kink else torch.autograd.grad(maps[:3], exact, [u.double() for u in upstream])
    )
    return outcome([m.detach() for m in found], [m.detach() for m in maps], by, exact_by)
