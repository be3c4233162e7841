import math

import numpy as np
import pytest
import torch

from refgs.model import cubemap, prefilter
from refgs.model.environment import Environment


def errors(radiance: torch.Tensor, fine: torch.Tensor, rows: int) -> list[float]:
    """Measure the relative RMS error of each prefiltered level of the cubemap `radiance`, at `rows` random texels.

    Exact values are sums over `fine`, a cubemap of the same light with more texels, weighted by the level's lobe.
    """
    side, fine_side = (math.isqrt(len(v) // 6) for v in (radiance, fine))
    levels = prefilter.prefilter(radiance, side).cpu()
    levels = cubemap.in_texel_order(levels, tuple(prefilter.level_sides(side))).numpy()
    directions, area = cubemap.texel_directions(fine_side).numpy(), cubemap.texel_solid_angles(fine_side).numpy()
    start, found, rng = 6 * side * side, [], np.random.default_rng(0)
    for level_side, lobe in zip(prefilter.level_sides(side)[1:], prefilter.LOBES, strict=True):
        axes = cubemap.texel_directions(level_side).numpy()
        chosen = rng.choice(len(axes), rows, replace=False)
        weight = lobe(axes[chosen] @ directions.T) * area
        expected = weight @ fine.numpy() / weight.sum(axis=1, keepdims=True)
        got = levels[start : start + len(axes)][chosen]
        found.append(float(np.sqrt(((got - expected) ** 2).mean()) / expected.mean()))
        start += len(axes)
    return found


def light(side: int) -> torch.Tensor:
    """Make a cubemap with a striped sky and a soft sun."""
    d, towards = cubemap.texel_directions(side), torch.tensor([0.3, 0.5, 0.8], dtype=torch.float64)
    sun = torch.exp(20 * (d @ towards / towards.norm() - 1))
    stripes = 0.3 + 0.2 * torch.sin(6 * d[:, 2])
    return torch.stack([stripes + 5 * sun, stripes + 3 * sun, stripes + sun], dim=-1).float()


def test_levels_match_direct_integration(device):
    """Check that each prefiltered level matches direct sums over a cubemap four times as fine, to 0.5 %."""
    assert max(errors(light(32).to(device), light(128), rows=40)) < 0.005


@pytest.mark.parametrize("side", [64, 128])
def test_levels_of_large_cubemaps_match_direct_integration(side):
    assert max(errors(light(side), light(4 * side), rows=16)) < 0.005


def test_smaller_cells_bring_the_error_down(monkeypatch):
    """Check that a prefiltered level's error at least halves if `prefilter.CELLS` is four times as large.

    The filter then reads finer texels of the light's mips. The light is constant within a texel of the cubemap. The sharpest lobe is left
    out: it is no wider than a texel, so its error is small from the start. Irradiance is left out, too: it always reads fine texels.
    """
    side, found = 32, []
    radiance = light(side)
    fine = radiance.reshape(6, side, 1, side, 1, 3).expand(6, side, 4, side, 4, 3).reshape(-1, 3)
    monkeypatch.setattr(prefilter, "matrices", prefilter.matrices.__wrapped__)  # without its cache
    for cells in (64, 256, 1024):
        monkeypatch.setattr(prefilter, "CELLS", cells)
        found.append(np.array(errors(radiance, fine, rows=40))[1:-1])  # without irradiance, which has cells of its own
    assert (found[1] < found[0] / 2).all() and (found[2] < found[1] / 2).all()


def test_constant_light_stays_constant():
    levels = prefilter.prefilter(torch.full((6 * 32 * 32, 3), 0.7), 32)
    torch.testing.assert_close(levels, torch.full_like(levels, 0.7), atol=1e-5, rtol=0)


def test_gradient_is_the_transpose(device):
    torch.manual_seed(0)
    x = torch.rand(6 * 16 * 16, 3).to(device).requires_grad_()
    y = prefilter.prefilter(x, 16)
    w = torch.rand_like(y)
    (y * w).sum().backward()
    other = torch.rand(6 * 16 * 16, 3).to(device)
    with torch.no_grad():
        change = (prefilter.prefilter(other, 16) * w).sum()
    assert float((x.grad * other).sum()) == pytest.approx(float(change), rel=1e-4)


def test_irradiance_teaches_only_the_texels_that_it_should(device):
    """Check that only the gradient by irradiance, the last level, is masked. A lamp learns from it although mirrors tell its radiance."""
    generator = torch.Generator().manual_seed(0)
    radiance = torch.rand(6 * 16 * 16, 3, generator=generator)
    radiance[5] = 3.0
    weight = torch.rand(prefilter.prefilter(radiance, 16).shape, generator=generator)
    told = torch.rand(6 * 8 * 8, generator=generator) < 0.5

    def gradient(told, levels):
        leaf = radiance.clone().to(device).requires_grad_()
        light = Environment(leaf, told=None if told is None else told.to(device))
        (light.levels[levels] * weight.to(device)[levels]).sum().backward()
        return leaf.grad.cpu()

    mirrored, diffuse = slice(-6 * 16**2), slice(-6 * 16**2, None)
    torch.testing.assert_close(gradient(told, mirrored), gradient(None, mirrored))
    fixed = told[cubemap.texels_at(cubemap.texel_directions(16), 8)]
    fixed[5] = False
    assert 0.3 < float(fixed.float().mean()) < 0.7
    torch.testing.assert_close(gradient(told, diffuse), gradient(None, diffuse) * ~fixed[:, None])


def test_irradiance_of_a_constant_and_of_a_cosine_sky():
    ones = Environment(torch.ones(6 * 16 * 16, 3))
    normals = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    torch.testing.assert_close(ones.diffuse(normals), torch.ones(50, 3), atol=1e-5, rtol=0)
    # Radiance 1 + z gives irradiance / π = 1 + (2/3) z.
    sky = Environment((1 + cubemap.texel_directions(32)[:, 2:]).float().repeat(1, 3))
    torch.testing.assert_close(sky.diffuse(normals)[:, 0], 1 + 2 / 3 * normals[:, 2], atol=3e-3, rtol=0)


def test_a_sun_leaves_what_faces_away_from_it_dark():
    """Check irradiance from a single bright texel: it follows the cosine, and is zero on surfaces that face away."""
    side, texel = 64, 1234
    directions = cubemap.texel_directions(side)
    radiance = torch.zeros(6 * side**2, 3)
    radiance[texel] = math.pi / cubemap.texel_solid_angles(side)[texel]
    cosine = directions @ directions[texel]
    found = Environment(radiance).diffuse(directions.float())[:, 0].double()
    error = (found - cosine.clamp_min(0)).abs()
    assert error.max() < 0.08 and error.square().mean().sqrt() < 0.02  # the tolerance is the width of a texel
    assert found[cosine < -0.15].max() < 1e-3


def test_panorama_round_trip():
    """Check that converting a smooth light from cubemap to panorama and back changes it by less than 0.5 % on average."""
    original = light(64)
    back = Environment.from_panorama(Environment(original).panorama(256), 64).radiance
    assert float((back - original).abs().mean() / original.mean()) < 0.005
