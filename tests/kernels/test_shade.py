"""Deferred shading against the float64 reference, and what physics says of it."""

import functools

import pytest
import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.kernels import load, reference
from refgs.model.environment import Environment
from refgs.render.shade import mirror_directions, shade
from tests.kernels import scenes

NAMES = ("features", "alpha", "levels", "irradiance")
# Pixels nearer to a kink of their derivatives than this are left out of the gradients; their share is checked.
MARGIN = 1e-4
FORWARD, GRADIENT = 1e-5, 1e-4
BACKGROUND = torch.tensor([0.2, 0.5, 1.0])


class Light:
    """What `shade` reads of an Environment, as leaves."""

    def __init__(self, dtype: torch.dtype, resolution: int = 16):
        generator = torch.Generator().manual_seed(2)
        exact = Environment(torch.exp(0.5 * torch.randn(6 * resolution**2, 3, generator=generator)))
        self.sides = exact.sides
        self.levels = exact.levels.to(dtype).requires_grad_()
        self.irradiance = (exact.irradiance + 0.3 * torch.randn(9, 3, generator=generator)).to(dtype).requires_grad_()


def means(camera: Camera, colours: int) -> tuple[Tensor, Tensor]:
    """Random maps that change over five pixels, displaced by up to ten; a third is empty. With so many colours between
    material and position."""
    generator = torch.Generator().manual_seed(1)

    def smooth(values: Tensor) -> Tensor:
        size = camera.height, camera.width
        return torch.nn.functional.interpolate(values[None], size, mode="bilinear")[0].permute(1, 2, 0)

    def uniform(channels: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        coarse = torch.rand(channels, -(-camera.height // 5), -(-camera.width // 5), generator=generator)
        return low + (high - low) * smooth(coarse)

    view = torch.from_numpy(camera.world_to_camera).float()
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    at = torch.stack([x, y], dim=-1) + uniform(2, -10, 10) * uniform(1) ** 2
    focal, middle = torch.tensor([camera.fx, camera.fy]), torch.tensor([camera.cx, camera.cy])
    depth = uniform(1, 1.5, 4)
    point = torch.cat([(at - middle) / focal * depth, depth], dim=-1)
    position = (point - view[:3, 3]) @ view[:3, :3]
    normal = (-view[2, :3] + uniform(3, -0.7, 0.7)) * uniform(1, 0.5, 1)
    parts = [normal, uniform(5), *([uniform(3 * colours, 0, 2)] if colours else []), position]
    alpha = (uniform(1, -0.5, 1).clamp_min(0))[..., 0]
    return torch.cat(parts, dim=-1), alpha


def visible(alpha: Tensor) -> Tensor:
    """Free, hidden, and between."""
    return (2 * torch.rand(alpha.shape, generator=torch.Generator().manual_seed(4)) - 0.5).clamp(0, 1)


@functools.cache
def case(appearance: bool, indirect: bool, size: tuple[int, int]):
    camera = scenes.camera(*size)
    mean, alpha = means(camera, appearance + indirect)
    inputs = (mean * alpha[..., None], alpha)
    light = Light(torch.float64)
    exact = [*(v.double().requires_grad_() for v in inputs), light.levels, light.irradiance]
    visibility = visible(alpha) if indirect else None
    *maps, margin = reference.shade(
        *exact[:3],
        light.sides,
        exact[3],
        camera,
        BACKGROUND.double(),
        None if visibility is None else visibility.double(),
    )
    safe = margin > MARGIN
    generator = torch.Generator().manual_seed(3)
    upstream = [torch.randn(m.shape, generator=generator) * safe[..., None] for m in maps[:3]]
    wanted = exact[: 3 if appearance else 4]  # with appearance nothing reads the irradiance
    gradients = torch.autograd.grad(maps[:3], wanted, [u.double() for u in upstream])
    return camera, inputs, visibility, [m.detach() for m in maps], safe, upstream, gradients


def run(
    camera: Camera,
    inputs: tuple[Tensor, ...],
    visibility: Tensor | None,
    upstream: list[Tensor],
    count: int = 4,
) -> tuple[list[Tensor], tuple]:
    light = Light(torch.float32)
    leaves = [*(v.clone().requires_grad_() for v in inputs), light.levels, light.irradiance]
    shaded = shade(*leaves[:2], light, camera, BACKGROUND, visibility)
    gradients = torch.autograd.grad(shaded[:3], leaves[:count], upstream)
    return [s.detach() for s in shaded], gradients


@pytest.mark.parametrize("isa", load.supported())
@pytest.mark.parametrize("size", [(45, 30), (37, 70), (9, 4)])
@pytest.mark.parametrize("appearance", [False, True])
@pytest.mark.parametrize("indirect", [False, True])
def test_matches_reference(indirect, appearance, size, isa, monkeypatch):
    monkeypatch.setenv("REFGS_ISA", isa)
    camera, inputs, visibility, maps, safe, upstream, gradients = case(appearance, indirect, size)
    assert safe.float().mean() > 0.9
    found, by = run(camera, inputs, visibility, upstream, len(gradients))
    for value, expected in zip(found, maps, strict=True):
        error = (value - expected)[safe].abs().max() / expected.abs().max()
        assert error <= FORWARD
    for name, value, expected in zip(NAMES, by, gradients, strict=False):
        error = (value - expected).abs().max() / expected.abs().max()
        assert error <= GRADIENT, (name, error.item())


@pytest.mark.parametrize("isa", load.supported())
def test_mirror_directions(isa, monkeypatch):
    """Of the reference's blended normals."""
    monkeypatch.setenv("REFGS_ISA", isa)
    camera, (features, alpha), _, maps, _, _, _ = case(False, True, (37, 70))
    covered = alpha > reference.COVERED
    normal, ray = reference.unit(maps[1][covered]), reference.unit(scenes.camera_rays(camera)[covered].double())
    expected = ray - 2 * (ray * normal).sum(dim=-1, keepdim=True) * normal
    found = mirror_directions(features, alpha, camera)
    assert (found[covered] - expected).abs().max() <= FORWARD
    assert found[~covered].eq(0).all()


def test_same_bits_for_any_number_of_threads():
    camera, inputs, visibility, _, _, upstream, _ = case(False, True, (37, 70))

    def all_of_it() -> list[Tensor]:
        maps, gradients = run(camera, inputs, visibility, upstream)
        return [*maps, *gradients]

    scenes.check_same_bits_for_any_number_of_threads(all_of_it)


def test_nothing_there():
    camera = scenes.camera(20, 10)
    leaves = torch.zeros(10, 20, 11, requires_grad=True), torch.zeros(10, 20, requires_grad=True)
    shaded = shade(*leaves, Light(torch.float32), camera, BACKGROUND)
    assert torch.equal(shaded.color, BACKGROUND.expand(10, 20, 3)) and shaded.normal.eq(0).all()
    by = torch.autograd.grad(shaded.color.sum(), leaves)
    assert all(b.eq(0).all() for b in by)


def white_ball(metallic: float, roughness: float, side: int = 64) -> Tensor:
    """Radiance of a white ball under a light of one, as an orthographic camera far away sees it."""
    camera = Camera("far", side, side, 1e4, 1e4, side / 2, side / 2, torch.eye(4, dtype=torch.float64).numpy())
    y, x = torch.meshgrid(*[(torch.arange(side) + 0.5) / side * 2 - 1] * 2, indexing="ij")
    inside = x**2 + y**2 < 1
    normal = torch.stack([x, y, -torch.sqrt((1 - x**2 - y**2).clamp_min(0))], dim=-1)
    pixel = torch.stack([x, y], dim=-1) * side / 2
    position = torch.cat([pixel / 1e4, torch.ones(side, side, 1)], dim=-1)
    material = torch.tensor([1.0, 1.0, 1.0, metallic, roughness]).expand(side, side, 5)
    alpha = inside.float()
    features = torch.cat([normal, material, position], dim=-1) * alpha[..., None]
    return shade(features, alpha, Environment(torch.ones(6 * 16**2, 3)), camera, torch.zeros(3)).radiance[inside]


@pytest.mark.parametrize("metallic", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("roughness", [0.0, 0.3, 1.0])
def test_white_furnace(metallic, roughness):
    """Under a light of one, nothing sends out more than it receives; a smooth mirror, and what is matte, no less."""
    radiance = white_ball(metallic, roughness)
    assert float(radiance.max()) <= 1 + 1e-3 and float(radiance.min()) > 0
    if roughness == 0:
        assert float(radiance.min()) >= 1 - 5e-3
