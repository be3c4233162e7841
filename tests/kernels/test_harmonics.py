"""Colour by direction against the harmonics in float64."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from refgs.kernels import reference
from refgs.model import harmonics
from refgs.render.directional import directional
from tests.kernels import scenes


def surfels(coefficients: int, count: int = 1000):
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(count, coefficients, 3, generator=generator)
    positions, normals = torch.randn(2, count, 3, generator=generator)
    return values, positions, torch.nn.functional.normalize(normals, dim=1)


def expected(values, offset, positions, camera, normals):
    along = reference.unit(positions.double() - torch.from_numpy(camera.position))
    if normals is not None:
        along = along - 2 * (along * normals).sum(dim=-1, keepdim=True) * normals
    basis = harmonics.basis(along, math.isqrt(values.shape[1]) - 1)
    return offset + torch.einsum("nk,nkc->nc", basis, values.double()), basis


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize("mirrored", [False, True])
def test_matches_reference(mirrored, coefficients, device):
    values, positions, normals = surfels(coefficients)
    camera, normals = scenes.camera(40, 30), normals if mirrored else None
    exact, basis = expected(values, 0.5, positions, camera, normals)
    constant, rest = (v.to(device).contiguous().requires_grad_() for v in values.split([1, coefficients - 1], dim=1))
    placed = None if normals is None else normals.to(device)
    color = directional(constant, rest, 0.5, positions.to(device), camera, placed)
    assert (color.cpu() - exact.clamp_min(0)).abs().max() / exact.abs().max() <= 1e-5
    upstream = torch.randn(color.shape, generator=torch.Generator().manual_seed(1))
    by = torch.cat(torch.autograd.grad(color, [constant, rest], upstream.to(device)), dim=1)
    exact_by = basis[..., None] * (upstream * (exact > 0))[:, None]
    assert (by.cpu() - exact_by).abs().max() / exact_by.abs().max() <= 1e-4


def test_same_bits_for_any_number_of_threads():
    values, positions, normals = surfels(16, count=5000)
    camera = scenes.camera(40, 30)

    def all_of_it():
        leaf = [v.clone().requires_grad_() for v in (values[:, :1], values[:, 1:])]
        color = directional(*leaf, 0.0, positions, camera, normals)
        return [color.detach(), *torch.autograd.grad(color.sum(), leaf)]

    scenes.check_same_bits_for_any_number_of_threads(all_of_it)


def test_light_from_the_object_turns_with_it():
    """The mirrored colour of surfels is that of the turned surfels, under the harmonics of the turned light."""
    values, positions, normals = surfels(4)
    camera = scenes.camera(40, 30)
    turn = torch.from_numpy(Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()).float()
    # Degree 1 is (-y, z, -x): its coefficients turn as a vector.
    vector = torch.stack([-values[:, 3], -values[:, 1], values[:, 2]], dim=1)
    x, y, z = torch.einsum("ab,nbc->nac", turn, vector).unbind(dim=1)
    turned = torch.stack([values[:, 0], -y, z, -x], dim=1)
    middle = torch.from_numpy(camera.position).float()  # about the camera, which then need not turn
    before = directional(values[:, :1], values[:, 1:], 0.5, positions, camera, normals)
    after = directional(
        turned[:, :1], turned[:, 1:], 0.5, (positions - middle) @ turn.T + middle, camera, normals @ turn.T
    )
    torch.testing.assert_close(before, after, atol=1e-5, rtol=0)
