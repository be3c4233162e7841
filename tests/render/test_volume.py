"""Compare 3D Gaussians, which the program draws as flat discs, with EWA splatting in float64."""

import numpy as np
import pytest
import torch

from refgs.render import reference
from refgs.render.rasterize import rasterize
from refgs.render.volume import across_the_axis, shortest_last
from tests.makers import scenes
from tests.makers.errors import check_near

CAMERA = scenes.camera(60, 40)


def gaussians(count: int, seed: int = 0) -> tuple[torch.Tensor, ...]:
    """Make random 3D Gaussians of different sizes that the camera sees. Return positions, rotations and scales."""
    generator = torch.Generator().manual_seed(seed)
    slope = torch.tensor([20 / CAMERA.fx, 14 / CAMERA.fy, 0.0]) * (2 * torch.rand(count, 3, generator=generator) - 1)
    depth = 2 + torch.rand(count, 1, generator=generator, dtype=torch.float64)
    view = torch.from_numpy(CAMERA.world_to_camera)
    positions = ((slope + torch.tensor([0.0, 0, 1])) * depth - view[:3, 3]) @ view[:3, :3]
    rotations = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    scales = torch.exp(torch.randn(count, 3, generator=generator, dtype=torch.float64) * 0.7 - 1.5)
    return positions, rotations, scales


def covariances(positions, rotations, scales) -> tuple[torch.Tensor, torch.Tensor]:
    """Project 3D Gaussians to the image (Zwicker et al. 2001, eq. 31, without the low-pass filter).

    Return their 2D covariances (N, 2, 2) and their centres (N, 2) in pixels.
    """
    view = torch.from_numpy(CAMERA.world_to_camera)
    t = positions @ view[:3, :3].T + view[:3, 3]
    z, zero = t[:, 2], torch.zeros(len(t), dtype=torch.float64)
    across = torch.stack([CAMERA.fx / z, zero, -CAMERA.fx * t[:, 0] / z**2], dim=-1)
    down = torch.stack([zero, CAMERA.fy / z, -CAMERA.fy * t[:, 1] / z**2], dim=-1)
    half = torch.stack([across, down], dim=1) @ view[:3, :3] @ reference.rotation_matrices(rotations) * scales[:, None]
    centre = torch.stack([CAMERA.fx * t[:, 0] / z + CAMERA.cx, CAMERA.fy * t[:, 1] / z + CAMERA.cy], dim=-1)
    return half @ half.transpose(1, 2), centre


def test_one_gaussians_picture_is_that_of_its_projected_covariance():
    for seed in range(5):
        one = gaussians(1, seed)
        covariance, centre = covariances(*one)
        y, x = torch.meshgrid(torch.arange(40) + 0.5, torch.arange(60) + 0.5, indexing="ij")
        apart = torch.stack([x, y], dim=-1) - centre[0]
        expected = 0.9 * torch.exp(-0.5 * (apart @ torch.linalg.inv(covariance[0]) * apart).sum(dim=-1))
        positions, *turned = (v.float() for v in one)
        discs = across_the_axis(positions, *turned, CAMERA)
        alpha = rasterize(positions, *discs, torch.tensor([0.9]), torch.ones(1, 1), CAMERA, near=0.1).alpha
        drawn = expected > 1 / 200
        assert drawn.sum() > 20 and (alpha - expected)[drawn].abs().max() < 2e-3


def test_gradients_are_those_of_the_projected_covariance():
    """Check a Gaussian's disc: its covariance in the image, and its gradients by position, rotation and scales.

    They match those of the projected 3D Gaussian in float64.
    """
    inputs = gaussians(50)
    upstream = torch.randn(50, 2, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    upstream = upstream + upstream.transpose(1, 2)

    def gradients(dtype, covariance):
        leaves = [v.to(dtype).requires_grad_() for v in inputs]
        return torch.autograd.grad((covariance(*leaves) * upstream.to(dtype)).sum(), leaves)

    def of_discs(positions, rotations, scales):
        discs, sizes = across_the_axis(positions, rotations, scales, CAMERA)
        view = torch.from_numpy(CAMERA.world_to_camera)
        axes = (view[:3, :3] @ reference.rotation_matrices(discs.double()))[:, :2, :2] * sizes.double()[:, None]
        depth = positions.double() @ view[2, :3] + view[2, 3]
        focal = torch.tensor([CAMERA.fx, CAMERA.fy], dtype=torch.float64)
        half = axes * focal[None, :, None] / depth[:, None, None]
        return (half @ half.transpose(1, 2)).to(positions.dtype)

    found = gradients(torch.float32, of_discs)
    expected = gradients(torch.float64, lambda *leaves: covariances(*leaves)[0])
    check_near(("positions", "rotations", "scales"), found, expected, 2e-3)
    with torch.no_grad():
        torch.testing.assert_close(of_discs(*inputs), covariances(*inputs)[0], rtol=1e-6, atol=1e-9)


def test_a_round_gaussian_feels_no_turn():
    leaves = [v.requires_grad_() for v in (torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.2))]
    rotations, scales = across_the_axis(*leaves, CAMERA)
    (rotations.sum() + scales.sum()).backward()
    assert all(leaf.grad.isfinite().all() for leaf in leaves)
    assert leaves[2].grad.abs().max() < 10


@pytest.mark.parametrize("shortest", [0, 1, 2])
def test_the_shortest_axis_comes_last(shortest):
    _, rotations, scales = gaussians(20)
    scales[torch.arange(20), shortest] = 0.01
    turned, ordered = shortest_last(rotations, scales)
    before, after = reference.rotation_matrices(rotations), reference.rotation_matrices(turned)
    np.testing.assert_allclose(after[:, :, 2], before[:, :, shortest], atol=1e-12)
    covariance = before * scales[:, None] ** 2 @ before.transpose(1, 2)
    torch.testing.assert_close(after * ordered[:, None] ** 2 @ after.transpose(1, 2), covariance)
