"""Compare the float32 kernels with a float64 reference implementation.

Errors are relative. The error of a tensor is its largest difference from the reference, divided by the reference's largest absolute value.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from benchmarks.stability.cases import Outcome
from refgs.camera import Camera
from refgs.model.environment import Environment
from refgs.render import reference
from refgs.render.rasterize import rasterize
from refgs.render.shade import shade

MARGIN = 1e-4  # pixels whose compared value is this near to a threshold are left out: rounding could flip them
SMOOTH = 2e-5  # pixels this near to a kink are left out of the derivatives
SAFE = 0.5  # least share of the picture, or of its drawn part, that must remain to be compared
FLOAT32 = "float32, sums of hundreds of terms"


class Undecided(Exception):
    """Report that less than a fraction SAFE of the pixels can be compared.

    The other pixels are too near to a threshold or a kink: rounding could change their values or gradients much.
    """


def worst(found: Sequence[Tensor], expected: Sequence[Tensor], terms: Sequence[Tensor] | None = None) -> float:
    """Return the largest relative error of several tensors.

    The error of a tensor is its largest difference from `expected`, divided by the largest absolute value in `expected`.

    A small difference of large numbers has the rounding errors of the large numbers. For tensors of such differences, `terms` has the large
    numbers. If the largest absolute value in `terms` is larger than that in `expected`, the error is divided by it instead.
    """
    errors = [0.0]
    for value, exact, summed in zip(found, expected, terms or expected, strict=True):
        if exact.numel():
            error, size = (value.double() - exact).abs().max(), torch.maximum(exact.abs().max(), summed.abs().max())
            errors.append(float(error / size if size > 1e-30 else error))
    return max(errors)


def outcome(
    found: Sequence[Tensor],
    expected: Sequence[Tensor],
    by: Sequence[Tensor],
    exact_by: Sequence[Tensor],
    terms: Sequence[Tensor] | None = None,
) -> Outcome:
    """Compare float32 values and gradients with float64.

    `found` are the float32 values and `by` the float32 gradients. `expected` and `exact_by` are the same in float64.

    Two relative errors are computed by `worst`: that of the values, and that of the gradients with `terms`. The error of the outcome is the
    maximum of the first and a tenth of the second.
    """
    finite = all(bool(v.isfinite().all()) for v in (*found, *by))
    return Outcome(finite, max(worst(found, expected), 0.1 * worst(by, exact_by, terms)))


def raster(inputs: Sequence[Tensor], camera: Camera, near: float = 0.1, nearest: int | None = None) -> Outcome:
    """Compare the rasteriser's images and gradients with the float64 reference.

    `inputs` are the surfels' tensors. The reference is slow: if `nearest` is given, it draws only this number of surfels, those nearest to
    the camera. They must hide all others.
    """
    order = None if nearest is None else _order(inputs, camera)
    few = inputs if order is None else [v[order[:nearest]] for v in inputs]
    exact = [v.double().requires_grad_() for v in few]
    *maps, margin = reference.rasterize(*exact, camera, near)
    safe, drawn = margin > MARGIN, maps[2] > 0
    if drawn.any() and safe[drawn].float().mean() < SAFE:
        raise Undecided(f"only {float(safe[drawn].float().mean()):.0%} of what is drawn can be compared")
    generator = torch.Generator().manual_seed(1)
    upstream = [
        torch.randn(m.shape, generator=generator) * safe.reshape(safe.shape + (1,) * (m.ndim - 2)) for m in maps
    ]
    exact_by = _parameter_gradients(
        torch.autograd.grad(maps, exact, [u.double() for u in upstream], retain_graph=True), few
    )
    terms = _terms(maps, upstream, exact, exact_by, generator)
    leaves = [v.clone().requires_grad_() for v in inputs]
    found = rasterize(*leaves, camera, near)
    by = _parameter_gradients(torch.autograd.grad(found, leaves, upstream), inputs)
    if order is not None:
        hidden = [g[order[nearest:]] for g in by]
        nothing = [torch.zeros_like(g).double() for g in hidden]
        exact_by, terms = [*exact_by, *nothing], [*terms, *nothing]
        by = [*(g[order[:nearest]] for g in by), *hidden]
    return outcome([m.detach()[safe] for m in found], [m.detach()[safe] for m in maps], by, exact_by, terms)


def _parameter_gradients(by: Sequence[Tensor], inputs: Sequence[Tensor]) -> list[Tensor]:
    """Convert gradients of the rasteriser's inputs, `by`, to gradients of the parameters that training optimises.

    The gradient of a quaternion becomes that of the rotation angle, the gradient of a scale that of its logarithm. The others stay.
    """
    position, rotation, scale, *rest = by
    return [position, rotation * inputs[1].double().norm(dim=-1, keepdim=True), scale * inputs[2].double(), *rest]


def _terms(
    maps: Sequence[Tensor],
    upstream: Sequence[Tensor],
    exact: Sequence[Tensor],
    exact_by: Sequence[Tensor],
    generator: torch.Generator,
) -> list[Tensor]:
    """Estimate the size of the large numbers whose small differences the gradients are. Return one tensor for each gradient.

    `worst` takes them as `terms`: the gradients have the rounding errors of these numbers. There are two sources:

    - The gradient of a surfel's alpha is the colour that the surfel adds, minus the colour that it hides. The kernel computes the hidden
      colour from the pixel's total colour, and so with the total's rounding error. To estimate its effect on all gradients, make a random
      gradient of the alpha image and propagate it back. In each pixel, it is the total, divided by 1 - alpha, times a random number.
    - The gradient of a rotation is a difference of gradients of positions, times the surfel's radius. So add the length of the position's
      gradient, times the radius. The gradient of a scale is a difference of gradients of rotations. So add the lengths of both.
    """
    features, depth, alpha = (m.detach() for m in maps)
    by_features, by_depth, by_alpha = upstream
    total = (features * by_features).abs().sum(dim=-1) + (depth * by_depth).abs() + (alpha * by_alpha).abs()
    by = torch.randn(total.shape, generator=generator) * total / (1 - alpha)
    inputs = [v.detach() for v in exact]
    terms = _parameter_gradients(torch.autograd.grad(maps[2], exact, by, materialize_grads=True), inputs)
    moved, turned = (v.norm(dim=-1, keepdim=True) for v in exact_by[:2])
    moved = moved * inputs[2].amax(dim=-1, keepdim=True)
    terms[1], terms[2] = terms[1].abs() + moved, terms[2].abs() + moved + turned
    return terms


def _order(inputs: Sequence[Tensor], camera: Camera) -> Tensor:
    depth = inputs[0].double() @ torch.from_numpy(camera.world_to_camera[2, :3]) + camera.world_to_camera[2, 3]
    return torch.argsort(depth.float(), stable=True)


def shading(features: Tensor, alpha: Tensor, radiance: Tensor, camera: Camera, kink: bool = False) -> Outcome:
    """Compare images and gradients of deferred shading with the float64 reference.

    `features` and `alpha` are the inputs of `shade`, and `radiance` (6·R², 3) is the light. Set `kink` if the derivative jumps in every
    pixel, so that gradients cannot be compared: they must then only be finite.
    """
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
