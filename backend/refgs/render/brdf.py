"""Tabulate the reflectance of a metallic-roughness material under uniform light.

This is the first factor of the split sum (Ref-Gaussian paper, Eq. 7).

The material is Blender's Principled BSDF with its defaults: GGX, height-correlated Smith shadowing, and multiple scattering between
microfacets (Kulla and Conty, "Revisiting Physically Based Shading at Imageworks", 2017). Metals use Schlick's approximation of Fresnel
reflectance. Dielectrics use the exact formula for the index of refraction IOR. Below the surface of a dielectric lies a diffuse base, which
receives the light that is not reflected.
"""

import itertools
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

IOR = 1.5  # the Principled BSDF's and glTF's default
LEAST_N_V = 1e-4  # as in light.h


def fresnel(cosine: np.ndarray) -> np.ndarray:
    """Compute a dielectric's unpolarised Fresnel reflectance from the cosine between light and normal."""
    inside = np.sqrt(IOR**2 - 1 + cosine**2)  # IOR times the refracted ray's cosine
    across, along = (IOR**2 * cosine - inside) / (IOR**2 * cosine + inside), (cosine - inside) / (cosine + inside)
    return (across**2 + along**2) / 2


def bounces(average_fresnel, energy, average_energy):
    """Return the factor by which multiple scattering between microfacets brightens a specular lobe (Kulla and Conty 2017).

    `energy` is the reflectance of the lobe with one bounce and no absorption (F = 1). `average_energy` is its mean over the hemisphere,
    weighted by the cosine. `average_fresnel` is the mean of the Fresnel term, with the same weights.
    """
    again = average_fresnel * average_energy / (1 - average_fresnel * (1 - average_energy))
    return 1 + again * (1 - energy) / energy


def _gauss(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the points and weights of a quadrature rule over 0..1, dense at both ends."""
    x, weight = np.polynomial.legendre.leggauss(nodes)
    angle = np.pi / 4 * (x + 1)
    return np.sin(angle) ** 2, weight * np.pi / 4 * np.sin(2 * angle)


def one_bounce(n_v: np.ndarray, roughness: float, nodes: int) -> np.ndarray:
    """Integrate the reflectance of a GGX surface with one bounce under uniform light, for three Fresnel terms F.

    Returns (3, P), for the cosines N·V in `n_v` (P,). The integral is ∫ D G2 F / (4 N·L N·V) N·L dL. The three F are 1 − (1 − V·H)⁵, (1 −
    V·H)⁵ and a dielectric's Fresnel reflectance.

    The integral is computed over the half vector H, where L is above the horizon. The variables are the azimuth and an angle ψ. The tangent
    of the angle between N and H is α tan ψ, so that D is smooth in ψ. `nodes` is the number of quadrature points per variable.
    """
    at, weight = _gauss(nodes)
    alpha, s_v = roughness**2, np.sqrt(1 - n_v**2)
    lambda_v = np.sqrt(1 + (alpha * s_v / n_v) ** 2)
    table = np.zeros((3, len(n_v)))
    # L is above the horizon for all azimuths up to the first angle, for none from the second.
    angle = np.arccos(n_v)
    limits = [0 * n_v, *(np.arctan(np.tan((np.pi / 2 + a) / 2) / alpha) for a in (-angle, angle))]
    for low, high in itertools.pairwise(limits):
        psi = low + (high - low) * at[:, None]  # (nodes, P)
        tangent = alpha * np.tan(psi)
        c_h = 1 / np.sqrt(1 + tangent**2)
        s_h = tangent * c_h
        above = np.arccos(np.clip(n_v * (1 / (2 * c_h) - c_h) / (s_v * s_h), -1, 1))
        v_h = s_v * s_h * np.cos(above * at[:, None, None]) + n_v * c_h  # (nodes, nodes, P)
        n_l = np.maximum(2 * c_h * v_h - n_v, 1e-12)
        g2 = 2 / (lambda_v + np.sqrt(1 - alpha**2 + (alpha / n_l) ** 2))  # Heitz 2014, eq. 99
        share = g2 * v_h
        square = (1 - np.minimum(v_h, 1)) ** 2
        schlick = share * square * square * np.sqrt(square)
        parts = np.stack([share - schlick, schlick, share * fresnel(v_h)], axis=1)
        by_azimuth = np.einsum("a,acpv->cpv", weight, parts)
        table += (
            (by_azimuth * np.sin(2 * psi) * above * weight[:, None] / c_h).sum(axis=1) * (high - low) / (np.pi * n_v)
        )
    return table


@lru_cache(maxsize=2)
def reflectance_table(size: int = 64, nodes: int = 16) -> Tensor:
    """Tabulate reflectance under uniform light: (size, size, 4). Rows are √roughness and columns √N·V, both from 0 to 1.

    The square roots put more entries at small values, where reflectance changes fastest. Linear interpolation errs by at most 0.001 where
    N·V and roughness exceed 0.02. The channels are:

    - 0 and 1: FG0 and FG1. With one bounce and Schlick's Fresnel term, the reflectance is F0·FG0 + FG1 (Karis 2013).
    - 2: the mean of FG0 + FG1 over the hemisphere, weighted by the cosine. It is the same for a whole row.
    - 3: the reflectance of a dielectric, with multiple scattering.
    """
    root = np.linspace(0, 1, size)
    n_v = np.clip(root**2, LEAST_N_V, 1 - 1e-12)
    cosine, weight = (v / 2 for v in np.polynomial.legendre.leggauss(64))
    average_fresnel = 2 * ((cosine + 0.5) * fresnel(cosine + 0.5)) @ weight
    table = np.empty((size, size, 4))
    for row, roughness in enumerate(np.maximum(root**2, 1e-3)):
        fg0, fg1, dielectric = one_bounce(n_v, roughness, nodes)
        energy = fg0 + fg1
        average_energy = np.interp(cosine + 0.5, n_v, energy) @ (2 * (cosine + 0.5) * weight)
        dielectric *= bounces(average_fresnel, energy, average_energy)
        table[row] = np.stack([fg0, fg1, np.full(size, average_energy), dielectric], axis=-1)
    return torch.from_numpy(table).float()


def look_up(n_v: Tensor, roughness: Tensor) -> Tensor:
    """Interpolate `reflectance_table` differentiably at cosines N·V (P,) and roughnesses (P,), giving (P, 4)."""
    values, at = reflectance_table().to(n_v.dtype), torch.stack([n_v, roughness], dim=-1)
    places = at.clamp(LEAST_N_V, 1).sqrt() * (len(values) - 1)
    low = places.detach().floor().clamp_max(len(values) - 2)
    (x, y), (column, row) = (places - low).unbind(-1), low.long().unbind(-1)
    top, bottom = (torch.lerp(values[r, column], values[r, column + 1], x[:, None]) for r in (row, row + 1))
    return torch.lerp(top, bottom, y[:, None])


def reflectance(n_v: Tensor, roughness: Tensor, albedo: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the reflectance under uniform light of a metal (P, 3) and of a dielectric (P, 1), for cosines N·V (P,) and roughnesses (P,).

    `albedo` (P, 3) is the metal's base colour.
    """
    fg0, fg1, average, dielectric = look_up(n_v, roughness).split(1, dim=-1)
    return (albedo * fg0 + fg1) * bounces((20 * albedo + 1) / 21, fg0 + fg1, average), dielectric
