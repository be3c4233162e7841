"""Evaluate real spherical harmonics up to degree 3, in 3D Gaussian splatting's order and sign convention."""

import math

import torch
from torch import Tensor

from refgs.formats.splats import DC

# Normalisation constants of the real harmonics (Sloan, "Stupid Spherical Harmonics Tricks", 2008, appendix A2).
C1 = math.sqrt(3 / (4 * math.pi))
C2 = (
    math.sqrt(15 / (4 * math.pi)),
    math.sqrt(5 / (16 * math.pi)),
    math.sqrt(15 / (16 * math.pi)),
)
C3 = (
    math.sqrt(35 / (32 * math.pi)),
    math.sqrt(105 / (4 * math.pi)),
    math.sqrt(21 / (32 * math.pi)),
    math.sqrt(7 / (16 * math.pi)),
    math.sqrt(105 / (16 * math.pi)),
)


def basis(directions: Tensor, degree: int) -> Tensor:
    """Evaluate all real spherical harmonics up to `degree` in unit directions (..., 3). Returns (..., K), where K = (degree + 1)².

    The signs are those of 3D Gaussian splatting's files: degree 1 is proportional to (−y, z, −x).
    """
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, DC)]
    if degree >= 1:
        values += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        values += [C2[0] * x * y, -C2[0] * y * z, C2[1] * (3 * z * z - 1), -C2[0] * x * z, C2[2] * (x * x - y * y)]
    if degree >= 3:
        values += [
            -C3[0] * y * (3 * x * x - y * y),
            C3[1] * x * y * z,
            -C3[2] * y * (5 * z * z - 1),
            C3[3] * z * (5 * z * z - 3),
            -C3[2] * x * (5 * z * z - 1),
            C3[4] * z * (x * x - y * y),
            -C3[0] * x * (x * x - 3 * y * y),
        ]
    return torch.stack(values, dim=-1)
