"""Compute the radiance that a surface reflects in three ways: by Monte Carlo, by the exact split sum, and by the program's kernels.

Monte Carlo integrates the rendering equation. The split sum approximates it, because it assumes N = V = R: its lobes neither stretch at
grazing angles nor end at the horizon. The kernels approximate the split sum by a cubemap's texels and a few roughness levels.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.model import cubemap
from refgs.model.environment import Environment
from refgs.model.prefilter import ggx_lobe
from refgs.render.brdf import bounces, fresnel, one_bounce
from refgs.render.shade import shade

ROUGHNESS, ANGLES = (0.05, 0.1, 0.2, 0.4, 0.7, 1.0), (0, 30, 60, 80)  # degrees between view and normal
RESOLUTION = 64
SHARPNESS = 200.0  # sharpness of the sun's lobe: a standard deviation of 4 degrees

Radiance = Callable[[np.ndarray], np.ndarray]


class Material(NamedTuple):
    metallic: float
    albedo: float


METAL, DIELECTRIC = Material(1.0, 0.7), Material(0.0, 0.5)


class View(NamedTuple):
    """Hold two unit directions from a surface with the normal +z: `way` to the camera, and `mirrored`, its mirror direction."""

    way: np.ndarray
    mirrored: np.ndarray

    @classmethod
    def at(cls, angle: float) -> "View":
        sine, cosine = np.sin(np.radians(angle)), np.cos(np.radians(angle))
        return cls(np.array([sine, 0, cosine]), np.array([-sine, 0, cosine]))


def light_and_view(kind: str, angle: float) -> tuple[Radiance, View]:
    """Return a light and a view. The light is a function from directions (P, 3) to radiance (P,).

    `kind` is "constant", "gradient" or "sun"; the sun is in the mirror direction. `angle` is in degrees between view and normal.
    """
    view, slope = View.at(angle), np.array([-0.48, 0.48, 0.424])
    lights = {
        "constant": lambda d: np.ones(len(d)),
        "gradient": lambda d: 1 + d @ slope,
        "sun": lambda d: 0.2 + 20 * np.exp(SHARPNESS * (d @ view.mirrored - 1)),
    }
    return lights[kind], view


class Reflected(NamedTuple):
    """Hold what a surface reflects of a constant light of radiance 1.

    `specular` is its specular and `base` its diffuse radiance. `bounces` is the factor for light that bounces several times between
    microfacets; it is part of `specular`.
    """

    bounces: float
    specular: float
    base: float

    @classmethod
    @functools.cache
    def of(cls, material: Material, n_v: float, roughness: float) -> "Reflected":
        x, weight = np.polynomial.legendre.leggauss(64)
        cosine, weight = (x + 1) / 2, weight / 2
        average_energy = one_bounce(cosine, roughness, 48)[:2].sum(axis=0) @ (2 * cosine * weight)
        fg0, fg1, dielectric = one_bounce(np.array([min(n_v, 1 - 1e-12)]), roughness, 64)[:, 0]
        average = (20 * material.albedo + 1) / 21 if material.metallic else (2 * cosine * fresnel(cosine)) @ weight
        scale = bounces(average, fg0 + fg1, average_energy)
        if material.metallic:
            return cls(scale, (material.albedo * fg0 + fg1) * scale, 0.0)
        return cls(scale, dielectric * scale, (1 - dielectric * scale) * material.albedo)


def even(angle: float, roughness: float, material: Material) -> float:
    """Compute exactly the radiance that a surface reflects under a constant light of radiance 1. `angle` is in degrees."""
    reflected = Reflected.of(material, View.at(angle).way[2], roughness)
    return reflected.specular + reflected.base


def half_vectors(sine, cosine, alpha: float, u: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Sample half vectors (..., 3) about +z by the distribution of visible normals (Heitz 2018).

    `u` in 0..1 and `phi` in 0..2π are random numbers. The view direction is (sine, 0, cosine).
    """
    length = np.hypot(alpha * sine, cosine)
    x, z = alpha * sine / length, cosine / length
    t1, t2 = np.sqrt(u) * np.cos(phi), np.sqrt(u) * np.sin(phi)
    s = (1 + z) / 2
    t2 = (1 - s) * np.sqrt(1 - t1**2) + s * t2
    up = np.sqrt(np.maximum(1 - t1**2 - t2**2, 0))
    half = np.stack([alpha * (up * x - t2 * z), alpha * t1, up * z + t2 * x], -1)
    return half / np.linalg.norm(half, axis=-1, keepdims=True)


def monte_carlo(kind: str, angle: float, roughness: float, material: Material, samples=30_000) -> tuple[float, float]:
    """Integrate the rendering equation by Monte Carlo. Return the reflected radiance and its standard error.

    Light directions are sampled in three equal parts: by visible normals (Heitz 2018), by the cosine, and towards the sun. The balance
    heuristic weights them.
    """
    light, (v, sun) = light_and_view(kind, angle)
    rng, alpha = np.random.default_rng(0), roughness**2
    n = samples // 3
    u, phi = rng.random((3, n)), 2 * np.pi * rng.random((3, n))

    half = half_vectors(v[0], v[2], alpha, u[0], phi[0])
    by_lobe = 2 * (half @ v)[:, None] * half - v

    by_cosine = np.stack([np.sqrt(u[1]) * np.cos(phi[1]), np.sqrt(u[1]) * np.sin(phi[1]), np.sqrt(1 - u[1])], -1)
    cosine = 1 + np.log(u[2] + (1 - u[2]) * np.exp(-2 * SHARPNESS)) / SHARPNESS
    sine = np.sqrt(np.maximum(1 - cosine**2, 0))
    side = np.array([sun[2], 0, -sun[0]])
    by_sun = cosine[:, None] * sun + (sine * np.cos(phi[2]))[:, None] * side
    by_sun[:, 1] += sine * np.sin(phi[2])

    d = np.concatenate([by_lobe, by_cosine, by_sun])
    n_l, n_v = d[:, 2], v[2]
    above = n_l > 0
    n_l = np.where(above, n_l, 1.0)
    half = d + v
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    v_h = np.clip(half @ v, 0, 1)
    ggx = alpha**2 / (np.pi * (half[:, 0] ** 2 + half[:, 1] ** 2 + (alpha * half[:, 2]) ** 2) ** 2)
    tails = [np.sqrt(1 + alpha**2 * (1 / c**2 - 1)) for c in (n_v, n_l)]
    schlick = material.albedo + (1 - material.albedo) * (1 - v_h) ** 5
    reflected = Reflected.of(material, n_v, roughness)
    lobe = ggx * 2 / (tails[0] + tails[1]) / (4 * n_v) * (schlick if material.metallic else fresnel(v_h))
    value = light(d) * (lobe * reflected.bounces + reflected.base * n_l / np.pi)
    density = ggx * 2 / (1 + tails[0]) / (4 * n_v) + n_l / np.pi
    density += SHARPNESS / (2 * np.pi * -np.expm1(-2 * SHARPNESS)) * np.exp(SHARPNESS * (d @ sun - 1))
    share = np.where(above, value / density, 0).reshape(3, n)  # the result is the sum of the three thirds' means
    return float(share.mean(axis=1).sum()), float(np.sqrt(share.var(axis=1).sum() / n))


def lobe_mean(light: Radiance, axes: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Average a light over GGX lobes: the split sum's prefiltered light, here by quadrature.

    Returns mean radiance (P,) from the lobes' unit axes (P, 3) and roughnesses (P,).
    """
    x, weight = np.polynomial.legendre.leggauss(200)
    psi, alpha = np.pi / 4 * (x + 1), roughness[:, None] ** 2
    tangent = alpha * np.tan(psi)  # tangent of half the angle from the axis
    cosine, sine = (1 - tangent**2) / (1 + tangent**2), 2 * tangent / (1 + tangent**2)
    weight = weight * ggx_lobe(cosine, roughness[:, None]) * sine * (1 + np.tan(psi) ** 2) / (1 + tangent**2)
    azimuth = 2 * np.pi * np.arange(64) / 64
    side = np.stack([axes[:, 2], 0 * axes[:, 0], -axes[:, 0]], axis=1)
    flat = np.hypot(axes[:, 0], axes[:, 2]) < 1e-6
    side[flat] = [1, 0, 0]
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    ring = np.cos(azimuth)[:, None] * side[:, None] + np.sin(azimuth)[:, None] * np.cross(axes, side)[:, None]
    means = np.empty(len(axes))
    for i in range(len(axes)):
        d = cosine[i, :, None, None] * axes[i] + sine[i, :, None, None] * ring[i]
        means[i] = weight[i] @ light(d.reshape(-1, 3)).reshape(200, 64).mean(axis=1) / weight[i].sum()
    return means


def split_sum(kind: str, angle: float, roughness: float, material: Material) -> float:
    """Compute the radiance that a surface reflects by the split sum: prefiltered light times the BRDF's integral, plus diffuse light.

    Both factors are exact. Diffuse light is Lambert's. `angle` is in degrees.
    """
    light, view = light_and_view(kind, angle)
    filtered = lobe_mean(light, view.mirrored[None], np.array([roughness]))[0]
    d, area = (v.numpy() for v in (cubemap.texel_directions(128), cubemap.texel_solid_angles(128)))
    received = (light(d) * np.maximum(d[:, 2], 0)) @ area / np.pi
    reflected = Reflected.of(material, view.way[2], roughness)
    return float(filtered * reflected.specular + received * reflected.base)


def pixels(view: View, materials: list[tuple[float, Material]]) -> tuple[Tensor, Camera]:
    """Make a row of pixels, one for each pair of roughness and material: their features, as `shade` takes them, and the camera."""
    count = len(materials)
    right, up = np.array([0.0, 1.0, 0.0]), np.cross(view.way, [0.0, 1.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, -up, -view.way])
    pose[:3, 3] = [0, 0, 1]  # one unit from the origin, with a view so narrow that all rays are parallel
    camera = Camera("view", count, 1, 1e6, 1e6, count / 2, 0.5, pose)
    across = (torch.arange(count, dtype=torch.float64) + 0.5 - count / 2) / 1e6
    features = torch.zeros(1, count, 11)
    features[0, :, 2] = 1
    for i, (roughness, material) in enumerate(materials):
        features[0, i, 3:6], features[0, i, 6], features[0, i, 7] = material.albedo, material.metallic, roughness
    features[0, :, 8:] = (across[:, None] * torch.from_numpy(right)).float()
    return features, camera


def environment(light: Radiance, resolution: int = RESOLUTION) -> Environment:
    """Make a grey Environment from a light, whose radiance is read at the centres of the cubemap's texels."""
    radiance = torch.from_numpy(light(cubemap.texel_directions(resolution).numpy())).float()
    return Environment(radiance[:, None].expand(-1, 3).contiguous())


def shaded(kind: str, angle: float, materials: list[tuple[float, Material]]) -> Tensor:
    """Compute the radiance (P,) that surfaces reflect by the program's kernels, for P pairs of roughness and material."""
    light, view = light_and_view(kind, angle)
    features, camera = pixels(view, materials)
    return shade(features, torch.ones(1, len(materials)), environment(light), camera, torch.zeros(3)).radiance[0, :, 0]
