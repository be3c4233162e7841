"""Compare the table of the BRDF's reflectances with numeric integrals and with renders by Cycles."""

import numpy as np
import pytest
import torch

from refgs.render.brdf import bounces, look_up, reflectance

# Radiance of a plane under a white world, by Cycles 4.5 with a default Principled BSDF and 65 000 samples; standard errors are 0.0003 to
# 0.0005. Columns: roughness, degrees from the normal, a metal of base colour (0.9, 0.6, 0.3), a black dielectric.
CYCLES = [
    (0.1, 60, (0.9031, 0.6125, 0.3219), 0.0892),
    (0.2, 0, (0.8999, 0.5996, 0.2997), 0.0400),
    (0.2, 80, (0.9332, 0.7325, 0.5355), 0.3506),
    (0.4, 60, (0.8967, 0.5948, 0.3058), 0.0794),
    (0.4, 80, (0.9064, 0.6414, 0.3955), 0.1974),
    (0.7, 0, (0.8650, 0.5157, 0.2331), 0.0294),
    (0.7, 60, (0.8669, 0.5225, 0.2425), 0.0458),
    (1.0, 0, (0.7724, 0.3502, 0.1274), 0.0138),
    (1.0, 80, (0.8406, 0.4879, 0.2295), 0.0477),
]


def schlick(cosine: np.ndarray) -> np.ndarray:
    return (1 - cosine) ** 5


def dielectric(cosine: np.ndarray) -> np.ndarray:
    """Compute the Fresnel reflectance of a dielectric with refractive index 1.5."""
    inside = np.sqrt(1 - (1 - cosine**2) / 1.5**2)
    across, along = (cosine - 1.5 * inside) / (cosine + 1.5 * inside), (inside - 1.5 * cosine) / (inside + 1.5 * cosine)
    return (across**2 + along**2) / 2


def integrate(n_v: np.ndarray, roughness: np.ndarray, nodes: int) -> np.ndarray:
    """Integrate D G2 F / (4 N·L N·V) N·L over all light directions L above the horizon, for three F. Return (3, P).

    F is 1 − (1 − V·H)⁵, (1 − V·H)⁵ (Schlick), and the Fresnel reflectance of a dielectric. `nodes` is the number of quadrature nodes in
    each dimension. Light directions are in polar coordinates about the mirrored view. The program's own table is integrated differently:
    over half vectors.
    """
    x, weight = np.polynomial.legendre.leggauss(nodes)
    at, weight = np.sin(np.pi / 4 * (x + 1)) ** 2, weight * np.pi / 4 * np.cos(np.pi / 2 * x)
    sums = []
    for chunk in np.array_split(np.arange(len(n_v)), max(1, len(n_v) * nodes**2 // 500_000)):
        c = n_v[chunk][:, None, None]
        a2, s = roughness[chunk][:, None, None] ** 4, np.sqrt(1 - c**2)
        total = np.zeros((3, len(chunk)))
        rise = np.arcsin(c)  # elevation of the mirrored view
        for low, high in ((0 * c, rise), (rise, np.pi - rise)):
            low, high = (np.arctan(np.tan(np.minimum(b, np.pi - 1e-9) / 2) / np.sqrt(a2)) for b in (low, high))
            psi = low + (high - low) * at[:, None]  # substitution for the polar angle β: tan β/2 = α tan ψ
            tangent = np.sqrt(a2) * np.tan(psi)
            c_b, s_b = (1 - tangent**2) / (1 + tangent**2), 2 * tangent / (1 + tangent**2)
            by_psi = 2 * np.sqrt(a2) * (1 + np.tan(psi) ** 2) / (1 + tangent**2) * (high - low) * weight[:, None]
            # Azimuths from -end to end are above the horizon.
            end = np.arccos(np.clip(-c * c_b / np.maximum(s * s_b, 1e-300), -1, 1))
            azimuth = end * at
            n_l = np.maximum(c_b * c + s_b * s * np.cos(azimuth), 1e-12)
            v_l = c_b * (2 * c**2 - 1) + s_b * np.cos(azimuth) * 2 * s * c
            v_h = np.sqrt(np.maximum(1 + v_l, 1e-30) / 2)
            n_h2 = ((n_l + c) / (2 * v_h)) ** 2
            # For small α, 1 - (1 - α²) N·H² cancels completely. So compute 1 - N·H² from H's component at right angles to N.
            across = (s_b * np.sin(azimuth)) ** 2
            within = (s + c_b * -s + s_b * np.cos(azimuth) * c) ** 2
            slope = (across + within) / (n_l + c) ** 2
            d = a2 / (np.pi * n_h2**2 * (slope + a2) ** 2)
            smith = [(np.sqrt(1 + a2 * (1 / n**2 - 1)) - 1) / 2 for n in (n_l, c)]
            share = d / (1 + smith[0] + smith[1]) / (4 * c) * s_b * by_psi * 2 * end * weight
            v_h = np.minimum(v_h, 1)
            for i, fresnel in enumerate((1 - schlick(v_h), schlick(v_h), dielectric(v_h))):
                total[i] += (fresnel * share).sum(axis=(1, 2))
        sums.append(total)
    return np.concatenate(sums, axis=1)


def grid(n_v: np.ndarray, roughness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return tuple(v.ravel() for v in np.meshgrid(n_v, roughness))


def test_the_integral_converges():
    """Check that `integrate` converges: with 32 nodes its error is below 2.5e-5, with 64 nodes below 1e-7."""
    points = grid(np.array([0.02, 0.05, 0.3, 0.7, 1 - 1e-9]), np.array([0.03, 0.05, 0.1, 0.3, 1.0]))
    finest = integrate(*points, 96)
    found = [abs(integrate(*points, nodes) - finest).max() for nodes in (32, 64)]
    assert found[0] < 2.5e-5 and found[1] < 1e-7, found


def test_table_everywhere():
    """Check that all values of the BRDF table are exact to 0.001, also between its entries.

    Reflectance is F0 · FG0 + FG1. The table holds FG0, FG1, the mean of FG0 + FG1 over all angles, and a dielectric's reflectance with
    multiple bounces. The reflectances for F0 = 0.04 and F0 = 1 are checked, too.
    """
    n_v, roughness = grid(np.linspace(0.02, 1 - 1e-9, 59), np.linspace(0.03, 1, 61))
    exact = integrate(n_v, roughness, 32)
    fg0, fg1, average, coat = look_up(torch.from_numpy(n_v), torch.from_numpy(roughness)).numpy().T
    x, weight = np.polynomial.legendre.leggauss(32)
    cosine = (x + 1) / 2
    energy = integrate(*grid(cosine, np.linspace(0.03, 1, 61)), 32)[:2].sum(axis=0).reshape(61, 32)
    average_energy = np.repeat(energy @ (cosine * weight), 59)
    coat_exact = exact[2] * bounces((dielectric(cosine) * cosine) @ weight, exact[0] + exact[1], average_energy)
    pairs = {
        "FG0": (fg0, exact[0]),
        "FG1": (fg1, exact[1]),
        "F0 = 0.04": (0.04 * fg0 + fg1, 0.04 * exact[0] + exact[1]),
        "F0 = 1": (fg0 + fg1, exact[0] + exact[1]),
        "the rows' mean": (average, average_energy),
        "dielectric": (coat, coat_exact),
    }
    for name, (found, expected) in pairs.items():
        error = abs(found - expected)
        at = error.argmax()
        assert error[at] < 1e-3, f"{name}: {error[at]:.1e} at N·V {n_v[at]:.3f}, roughness {roughness[at]:.3f}"


@pytest.mark.parametrize(("roughness", "angle", "metal", "black"), CYCLES)
def test_reflects_as_cycles_does(roughness, angle, metal, black):
    """Check the reflectance of a metal and the specular reflectance of a dielectric: they agree with Cycles to 0.0015."""
    n_v, albedo = torch.tensor([np.cos(np.radians(angle))]), torch.tensor([[0.9, 0.6, 0.3]]).double()
    found = reflectance(n_v, torch.tensor([roughness]).double(), albedo)
    assert found[0][0].tolist() == pytest.approx(metal, abs=1.5e-3)
    assert found[1][0].tolist() == pytest.approx([black], abs=1.5e-3)
