import numpy as np
import pytest
import torch

from refgs.model import cubemap, prefilter
from refgs.model.environment import Environment


def light(side: int) -> torch.Tensor:
    """A sky with a soft sun and some stripes."""
    d = cubemap.texel_directions(side)
    sun = torch.exp(
        20 * (d @ torch.nn.functional.normalize(torch.tensor([0.3, 0.5, 0.8], dtype=torch.float64), dim=0) - 1)
    )
    stripes = 0.3 + 0.2 * torch.sin(6 * d[:, 2])
    return torch.stack([stripes + 5 * sun, stripes + 3 * sun, stripes + sun], dim=-1).float()


def test_levels_match_direct_integration(device):
    """Each level against the sum of the lobe over a cubemap four times as fine."""
    side, fine = 32, 128
    levels = prefilter.prefilter(light(side).to(device), side).cpu()
    directions, area = cubemap.texel_directions(fine).numpy(), cubemap.texel_solid_angles(fine).numpy()
    radiance = light(fine).numpy()
    start = 6 * side * side
    rng = np.random.default_rng(0)
    for level_side, roughness in zip(prefilter.level_sides(side)[1:], prefilter.ROUGHNESS[1:], strict=True):
        axes = cubemap.texel_directions(level_side).numpy()
        chosen = rng.choice(len(axes), min(40, len(axes)), replace=False)
        lobe = prefilter.ggx_lobe(axes[chosen] @ directions.T, roughness) * area
        expected = lobe @ radiance / lobe.sum(axis=1, keepdims=True)
        got = levels[start : start + len(axes)].numpy()[chosen]
        assert np.sqrt(((got - expected) ** 2).mean()) < 0.01 * expected.mean()
        start += len(axes)


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


def test_irradiance_of_a_constant_and_of_a_cosine_sky():
    ones = Environment(torch.ones(6 * 16 * 16, 3))
    normals = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    torch.testing.assert_close(ones.diffuse(normals), torch.ones(50, 3), atol=1e-5, rtol=0)
    # L = 1 + z: irradiance / π = 1 + (2/3) z.
    sky = Environment((1 + cubemap.texel_directions(32)[:, 2:]).float().repeat(1, 3))
    torch.testing.assert_close(sky.diffuse(normals)[:, 0], 1 + 2 / 3 * normals[:, 2], atol=2e-3, rtol=0)


def test_panorama_round_trip():
    """Cubemap → environment.exr → cubemap loses little of a light that the texels resolve."""
    original = light(64)
    panorama = Environment(original).panorama(256)
    back = Environment.from_panorama(panorama, 64).radiance
    assert float((back - original).abs().mean() / original.mean()) < 0.005
