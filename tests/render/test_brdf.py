import math

import numpy as np
import pytest
import torch

from refgs.kernels import reference


def integrate(n_v: float, roughness: float, f0: float, steps: int = 1500) -> float:
    """∫ f_s (N·L) dL by quadrature over the half vector, in float64: independent of the table's sampling."""
    a = roughness**2
    u = (np.arange(steps) + 0.5) / steps
    # θ_h from the CDF of D cos θ gives a smooth integrand; φ uniform.
    cos_h = np.sqrt((1 - u) / (1 + (a * a - 1) * u))[:, None]
    phi = 2 * math.pi * ((np.arange(steps // 2) + 0.5) / (steps // 2))[None, :]
    sin_h = np.sqrt(1 - cos_h**2)
    v_h = math.sqrt(1 - n_v**2) * sin_h * np.cos(phi) + n_v * cos_h
    n_l = 2 * v_h * cos_h - n_v
    seen = (n_l > 0) & (v_h > 0)
    n_l = np.where(seen, n_l, 1.0)

    def lam(c):
        return (np.sqrt(1 + a * a * (1 - c * c) / (c * c)) - 1) / 2

    g = 1 / (1 + lam(n_l) + lam(np.array(n_v)))
    fresnel = f0 + (1 - f0) * (1 - np.clip(v_h, 0, 1)) ** 5
    return float(np.where(seen, fresnel * g * v_h / (cos_h * n_v), 0).mean())


@pytest.mark.parametrize("roughness", [0.1, 0.25, 0.5, 0.9])
@pytest.mark.parametrize("n_v", [0.15, 0.5, 0.95])
def test_table_matches_quadrature(n_v, roughness):
    fg0, fg1 = reference.fg(torch.tensor([n_v]), torch.tensor([roughness]))
    for f0 in (0.04, 1.0):
        assert float(f0 * fg0 + fg1) == pytest.approx(integrate(n_v, roughness, f0), abs=2e-3)
