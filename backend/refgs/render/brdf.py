"""The first factor of the split sum (paper Eq. 7): what a metallic-roughness material reflects of an even light."""

import math
from functools import lru_cache

import torch
from torch import Tensor

DIELECTRIC_F0 = 0.04  # index of refraction 1.5: the Principled BSDF's and glTF's default


def smith_g2(n_l: Tensor, n_v: Tensor, alpha: Tensor) -> Tensor:
    """Height-correlated Smith masking-shadowing for GGX (Heitz 2014, eq. 99), as Cycles and Eevee use it."""

    def lam(cosine: Tensor) -> Tensor:
        tangent2 = (1 - cosine**2) / cosine**2
        return (torch.sqrt(1 + alpha**2 * tangent2) - 1) / 2

    return 1 / (1 + lam(n_l) + lam(n_v))


@lru_cache(maxsize=2)
def fg_table(size: int = 64, steps: int = 32) -> Tensor:
    """The first factor of the split sum, (2, size, size) over (roughness row, N·V column), at cell centres.

    FG0·F0 + FG1 is ∫ f_s (N·L) dL for Schlick's Fresnel with F0 (Karis 2013). The integral is the mean of F·G2/G1 over
    the distribution of visible normals (Heitz, "Sampling the GGX Distribution of Visible Normals", 2018), taken by the
    midpoint rule over his disc's polar coordinates; half the disc, as the other half mirrors it. With r = sin θ the
    integrand stays smooth at the rim.
    """
    mid = (torch.arange(steps, dtype=torch.float64) + 0.5) / steps
    theta = math.pi / 2 * mid[:, None]
    r, phi = torch.sin(theta), math.pi * (mid - 0.5)[None, :]
    area = torch.sin(2 * theta).repeat(1, steps).flatten()
    area = area / area.sum()
    t1, t2 = (r * torch.cos(phi)).flatten(), (r * torch.sin(phi)).flatten()
    centres = (torch.arange(size, dtype=torch.float64) + 0.5) / size
    n_v = centres[:, None]
    s_v = torch.sqrt(1 - n_v**2)
    table = torch.empty(2, size, size, dtype=torch.float64)
    for row, roughness in enumerate(centres):
        alpha = roughness**2
        stretch = torch.sqrt((alpha * s_v) ** 2 + n_v**2)
        v_x, v_z = alpha * s_v / stretch, n_v / stretch  # the view in the stretched space; T1 = y, T2 = V × T1
        s = (1 + v_z) / 2
        rim = torch.sqrt(1 - t1**2)
        t2_warped = (1 - s) * rim + s * t2
        up = torch.sqrt((1 - t1**2 - t2_warped**2).clamp_min(0))
        h_x = alpha * (-v_z * t2_warped + v_x * up)
        h_y = alpha * t1
        h_z = (v_x * t2_warped + v_z * up).clamp_min(1e-9)
        length = torch.sqrt(h_x**2 + h_y**2 + h_z**2)
        h_x, h_z = h_x / length, h_z / length
        v_h = (s_v * h_x + n_v * h_z).clamp(0, 1)
        n_l = 2 * v_h * h_z - n_v
        ratio = smith_g2(n_l.clamp_min(1e-9), n_v, alpha) / smith_g2(torch.ones_like(n_v), n_v, alpha)
        weight = torch.where(n_l > 0, ratio, 0.0)
        fresnel = (1 - v_h) ** 5
        table[0, row] = ((1 - fresnel) * weight) @ area
        table[1, row] = (fresnel * weight) @ area
    return table.float()
