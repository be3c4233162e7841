"""Compare the kernel that turns normals towards the camera with torch in float64."""

import torch
from torch import Tensor

from refgs.render import reference
from refgs.render.facing import facing_normals
from tests.makers import scenes


def surfels(count: int = 1000) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    lengths = 10 ** (2 * torch.rand(count, 1, generator=generator) - 1)
    return torch.randn(count, 4, generator=generator) * lengths, torch.randn(count, 3, generator=generator)


def test_matches_float64(device):
    (rotations, positions), camera = surfels(), scenes.camera(40, 30)
    exact, leaf = rotations.double().requires_grad_(), rotations.to(device).requires_grad_()
    axes = reference.rotation_matrices(exact)[..., 2]
    towards = reference.unit(torch.from_numpy(camera.position) - positions.double())
    cosine = (axes.detach() * towards).sum(dim=-1, keepdim=True)
    assert ((cosine + 0.3).abs() > 1e-6).all() and 0.2 < float((cosine < -0.3).float().mean()) < 0.5
    expected = torch.where(cosine < -0.3, -axes, axes)
    normals = facing_normals(leaf, positions.to(device), camera)
    assert (normals.cpu() - expected).abs().max() <= 1e-5
    upstream = torch.randn(normals.shape, generator=torch.Generator().manual_seed(1))
    (by,) = torch.autograd.grad(normals, leaf, upstream.to(device))
    (exact_by,) = torch.autograd.grad(expected, exact, upstream.double())
    assert ((by.cpu() - exact_by).norm(dim=1) <= 1e-4 * (upstream.norm(dim=1) / rotations.norm(dim=1))).all()


def test_a_rotation_that_says_nothing():
    leaf = torch.tensor([[0.0, 0, 0, 0], [1e-13, 1e-13, 0, 0]], requires_grad=True)
    normals = facing_normals(leaf, torch.zeros(2, 3), scenes.camera(40, 30))
    (by,) = torch.autograd.grad(normals.sum(), leaf)
    assert (normals.abs() == torch.tensor([0.0, 0, 1])).all() and (by == 0).all()


def test_same_bits_for_any_number_of_threads():
    rotations, positions = surfels(5000)

    def all_of_it() -> list[Tensor]:
        leaf = rotations.clone().requires_grad_()
        normals = facing_normals(leaf, positions, scenes.camera(40, 30))
        return [normals.detach(), *torch.autograd.grad((normals * positions).sum(), leaf)]

    scenes.check_same_bits_for_any_number_of_threads(all_of_it)
