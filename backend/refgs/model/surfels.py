"""Represent surfels by raw parameters, which are learned, and by the values after the activation functions, which are rendered."""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from refgs.clock import timed
from refgs.formats.splats import Splats
from refgs.kernels.function import Function
from refgs.kernels.layout import struct
from refgs.kernels.load import run
from refgs.model import harmonics

FLAT = 0.3  # initial thickness of 3D Gaussians, as a part of their width
_EXP, _SIGMOID, _SMOOTHSTEP = range(3)  # `enum Kind` of activate.cpp
_KINDS = {"scale": _EXP, "opacity": _SIGMOID, "albedo": _SIGMOID, "metallic": _SMOOTHSTEP, "roughness": _SIGMOID}

Parameters = dict[str, Tensor]
"""Raw leaf tensors, one row a surfel: position (N, 3); rotation (N, 4) wxyz; scale (N, 2) log, (N, 3) for 3D Gaussians; opacity (N,)
logit; sh_dc (N, 1, 3); sh_rest (N, K − 1, 3); albedo (N, 3) logit; metallic (N,), activated as 3 s² − 2 s³ of its logistic s; roughness
(N,) logit; received (N, 3), which is traced, not learned; indirect_dc and indirect_rest, of the shapes of sh."""


def axes(rotations: Tensor) -> list[Tensor]:
    """Convert quaternions wxyz of any length to rotation matrices' three columns, (N, 3) each."""
    w, x, y, z = torch.nn.functional.normalize(rotations, dim=-1).unbind(-1)
    return [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], dim=-1),
        torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], dim=-1),
        torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=-1),
    ]


class Surfels(NamedTuple):
    """Hold N surfels as they are rendered: their values after the activation functions.

    - `positions` (N, 3) and `scales` (N, 2), standard deviations along two axes, are in world units. 3D Gaussians have `scales` (N, 3).
    - `rotations` (N, 4) are quaternions wxyz of any length. `opacities` (N,) are in 0..1.
    - `albedo` (N, 3), linear Rec.709, `metallic` (N,) and `roughness` (N,) are in 0..1.
    - `sh_dc` (N, 1, 3) and `sh_rest` (N, K − 1, 3) are spherical harmonics of a view-dependent colour: colour = 0.5 + SH. The constant
      harmonic is separate because it has its own learning rate.
    - `received` (N, 3) is the irradiance at the surfel divided by the irradiance without occlusion. It can exceed 1 where the object
      reflects light onto itself.
    - `indirect_dc` (N, 1, 3) and `indirect_rest` (N, K − 1, 3) are spherical harmonics of the linear radiance that comes to the surfel from
      the object itself (Ref-Gaussian paper, Eq. 10).
    """

    positions: Tensor
    rotations: Tensor
    scales: Tensor
    opacities: Tensor
    sh_dc: Tensor
    sh_rest: Tensor
    albedo: Tensor
    metallic: Tensor
    roughness: Tensor
    received: Tensor
    indirect_dc: Tensor
    indirect_rest: Tensor

    def normals(self) -> Tensor:
        """Return the unit normals (N, 3); 3D Gaussians first need `with_normals_last`."""
        return axes(self.rotations)[2]

    def without_directions(self) -> "Surfels":
        """Drop the colour's dependence on viewing direction: all harmonics except the constant."""
        return self._replace(sh_rest=self.sh_rest[:, :0])

    def chosen(self, which: Tensor) -> "Surfels":
        """Return the surfels that a mask (N,) or an array of indices selects."""
        return Surfels(*(value[which] for value in self))

    def turned(self, which: Tensor) -> "Surfels":
        """Return all surfels, with flipped normals where the mask `which` (N,) is true."""
        w, x, y, z = self.rotations.unbind(-1)
        turned = torch.stack([-x, w, z, -y], dim=-1)  # q · (0, 1, 0, 0): a half turn about t_u
        return self._replace(rotations=torch.where(which[:, None], turned, self.rotations))


_Work = struct("Activate", "activate.cpp")


@timed("surfels")
class _Activate(Function):
    @staticmethod
    def forward(ctx, *raw):
        raw = [tensor.contiguous() for tensor in raw]
        values, work = [torch.empty_like(tensor) for tensor in raw], _Work(tensors=len(raw))
        for i, (kind, tensor, value) in enumerate(zip(_KINDS.values(), raw, values, strict=True)):
            slot = work.activations[i]
            slot.count, slot.kind = tensor.numel(), kind
            slot.attach(raw=tensor, value=value)
        run("refgs_activate_forward", work, raw[0], items=sum(tensor.numel() for tensor in raw))
        ctx.save_for_backward(*raw, *values)
        ctx.mark_non_differentiable(*(v for v, needed in zip(values, ctx.needs_input_grad, strict=True) if not needed))
        return tuple(values)

    @staticmethod
    @once_differentiable
    def backward(ctx, *by_values):
        raw, values = ctx.saved_tensors[: len(by_values)], ctx.saved_tensors[len(by_values) :]
        work, by_raw = (
            _Work(),
            [torch.empty_like(v) if n else None for v, n in zip(values, ctx.needs_input_grad, strict=True)],
        )
        by_values = [by.contiguous() for by in by_values]
        for kind, r, value, by_value, by in zip(_KINDS.values(), raw, values, by_values, by_raw, strict=True):
            if by is not None:
                slot = work.activations[work.tensors]
                slot.count, slot.kind = by.numel(), kind
                slot.attach(raw=r, value=value, by_value=by_value, by_raw=by)
                work.tensors += 1
        run("refgs_activate_backward", work, values[0], items=sum(value.numel() for value in values))
        return tuple(by_raw)


def activate(p: Parameters) -> Surfels:
    """Apply the activation functions to the raw parameters `p` (see `Parameters`). Returns the surfels as they are rendered.

    The activation of metallic gets closer to 0 and 1 than the logistic function. This matters for mirrors: with a metallic value of 0.985,
    a mirror also has a faint white diffuse reflection, as bright as the mirror image of a dark corner. Training then makes the light in
    this corner too dark, to compensate.
    """
    scales, opacities, albedo, metallic, roughness = _Activate.apply(*(p[name] for name in _KINDS))
    return Surfels(
        positions=p["position"],
        rotations=p["rotation"],
        scales=scales,
        opacities=opacities,
        sh_dc=p["sh_dc"],
        sh_rest=p["sh_rest"],
        albedo=albedo,
        metallic=metallic,
        roughness=roughness,
        received=p["received"].detach(),
        indirect_dc=p["indirect_dc"],
        indirect_rest=p["indirect_rest"],
    )


def quaternions_towards(normals: np.ndarray) -> np.ndarray:
    """Return the quaternions wxyz (N, 4) of the shortest rotations from +z to `normals`."""
    x, y, z = normals.T
    q = np.stack([1 + z, -y, x, np.zeros_like(z)], axis=1)
    q[1 + z < 1e-6] = (0, 1, 0, 0)  # straight down: a half turn about x
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def raw_metallic(metallic: float) -> float:
    """Return the raw parameter that activates to `metallic`, strictly between 0 and 1."""
    s = 0.5 - math.sin(math.asin(1 - 2 * metallic) / 3)  # 3 s² − 2 s³ = metallic
    return math.log(s / (1 - s))


def initial_parameters(
    positions: np.ndarray,
    normals: np.ndarray,
    spacing: np.ndarray,
    colours: np.ndarray | None,
    *,
    axes: int = 2,
    opacity: float,
    sh_degree: int,
    albedo: float,
    metallic: float,
    roughness: float,
) -> Parameters:
    """Make the raw parameters of N round surfels at `positions` (N, 3) with unit `normals` (N, 3).

    `spacing` (N,) becomes the surfels' standard deviation, in world units. `colours` (N, 3), sRGB-encoded in 0..1, become the spherical
    harmonics; without them, all surfels are grey. The other arguments are the same for all surfels, after activation. With `axes=3` the
    result is 3D Gaussians, whose third scale, along the normal, is FLAT times the other two.
    """
    n = len(positions)

    def logit(value: float, *shape: int) -> Tensor:
        return torch.full(shape, float(np.log(value / (1 - value))))

    rest = (sh_degree + 1) ** 2 - 1

    colour = torch.full((n, 3), 0.5) if colours is None else torch.from_numpy(np.asarray(colours, np.float32))
    parameters = {
        "position": torch.from_numpy(np.asarray(positions, np.float32).copy()),
        "rotation": torch.from_numpy(quaternions_towards(np.asarray(normals, np.float64)).astype(np.float32)),
        "scale": torch.from_numpy(np.log(np.maximum(spacing, 1e-12)).astype(np.float32))[:, None]
        + torch.tensor([0.0, 0.0, math.log(FLAT)])[:axes],
        "opacity": logit(opacity, n),
        "sh_dc": ((colour - 0.5) / harmonics.DC)[:, None].contiguous(),
        "sh_rest": torch.zeros(n, rest, 3),
        "albedo": logit(albedo, n, 3),
        "metallic": torch.full((n,), raw_metallic(metallic)),
        "roughness": logit(roughness, n),
        "received": torch.ones(n, 3),
        "indirect_dc": torch.zeros(n, 1, 3),
        "indirect_rest": torch.zeros(n, rest, 3),
    }
    return {name: value.requires_grad_() for name, value in parameters.items()}


def to_splats(surfels: Surfels) -> Splats:
    """Convert surfels to the table `Splats` that is stored in splats.ply."""
    with torch.no_grad():
        values = surfels._asdict() | {"normals": surfels.normals()}
        values["rotations"] = torch.nn.functional.normalize(surfels.rotations, dim=-1)
        for name in ("sh", "indirect"):
            values[name] = torch.cat([values.pop(f"{name}_dc"), values.pop(f"{name}_rest")], dim=1)
        arrays: dict[str, Any] = {name: value.numpy(force=True) for name, value in values.items()}
        return Splats(**arrays)


def from_splats(splats: Splats) -> Surfels:
    """Convert the table `Splats` that is stored in splats.ply to surfels."""
    values = {name: getattr(splats, name) for name in Surfels._fields if hasattr(splats, name)}
    for name in ("sh", "indirect"):
        coefficients = getattr(splats, name)
        values |= {f"{name}_dc": coefficients[:, :1], f"{name}_rest": coefficients[:, 1:]}
    return Surfels(**{name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in values.items()})
