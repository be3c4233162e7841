"""Compare the kernel for view-dependent colour with spherical harmonics in float64."""

import dataclasses
import math

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from refgs.formats.mesh import Mesh
from refgs.geometry.visibility import Occluder
from refgs.model import harmonics
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render import reference
from refgs.render.directional import directional
from refgs.render.renderer import render
from refgs.settings import load_settings
from tests.makers import scenes


def surfels(coefficients: int, count: int = 1000):
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(count, coefficients, 3, generator=generator)
    positions, normals = torch.randn(2, count, 3, generator=generator)
    return values, positions, torch.nn.functional.normalize(normals, dim=1)


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize("mirrored", [False, True])
def test_matches_reference(mirrored, coefficients, device):
    (values, positions, normals), camera = surfels(coefficients), scenes.camera(40, 30)
    along = reference.unit(positions.double() - torch.from_numpy(camera.position))
    if mirrored:
        along = along - 2 * (along * normals).sum(dim=-1, keepdim=True) * normals
    basis = harmonics.basis(along, math.isqrt(coefficients) - 1)
    exact = 0.5 + torch.einsum("nk,nkc->nc", basis, values.double())
    constant, rest = (v.to(device).contiguous().requires_grad_() for v in values.split([1, coefficients - 1], dim=1))
    color = directional(constant, rest, 0.5, positions.to(device), camera, normals.to(device) if mirrored else None)
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


def turned(values, turn):
    """Rotate spherical harmonics (N, K, 3) by the matrix `turn` (3, 3).

    Each direction's colour becomes that of the rotated direction.
    """
    directions = torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(2)).double())
    degree = math.isqrt(values.shape[1]) - 1
    before, after = (harmonics.basis(d, degree) for d in (directions, directions @ turn.T))
    return torch.einsum("ij,njc->nic", torch.linalg.lstsq(after, before).solution, values.double()).float()


TURN = torch.from_numpy(Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix())


@pytest.mark.parametrize("coefficients", [4, 9, 16])
@pytest.mark.parametrize("mirrored", [False, True])
def test_harmonics_are_of_the_world(mirrored, coefficients):
    """Check that a surfel rotated about the camera keeps its colour if its harmonics rotate too, and changes it otherwise.

    If `mirrored`, harmonics are evaluated in the mirror direction in place of the view direction.
    """
    values, positions, normals = surfels(coefficients)
    camera, turn = scenes.camera(40, 30), TURN.float()
    middle = torch.from_numpy(camera.position).float()  # rotate about the camera, so that it need not move
    there, normals_there = (positions - middle) @ turn.T + middle, normals @ turn.T

    def colour(values, positions, normals):
        return directional(values[:, :1], values[:, 1:], 0.5, positions, camera, normals if mirrored else None)

    before = colour(values, positions, normals)
    torch.testing.assert_close(before, colour(turned(values, TURN), there, normals_there), atol=2e-5, rtol=0)
    assert (before - colour(values, there, normals_there)).abs().mean() > 0.1


def test_a_picture_turns_with_its_object():
    """Check that the picture stays the same if surfels, camera, harmonics and occluding mesh are rotated together.

    The mesh is a closed room that hides the environment, so reflections show only the light stored in the surfels' harmonics.
    """
    generator = torch.Generator().manual_seed(3)
    positions, rotations, scales, opacities, _ = scenes.surfels("mixed", 1)
    count = len(positions)
    sh, indirect = 0.3 * torch.randn(2, count, 16, 3, generator=generator)
    indirect[:, 0] += 2
    materials = torch.rand(5, count, generator=generator)
    room = trimesh.creation.icosphere(4, 20)
    camera, environment = scenes.camera(40, 30), Environment(torch.ones(6 * 16**2, 3))
    settings = load_settings("quick", ["diffuse=sh"]).render

    def picture(turn, sh, indirect):
        pose = camera.world_to_camera.copy()
        pose[:3, :3] = pose[:3, :3] @ turn.T
        quaternions = Rotation.from_quat(rotations.numpy()[:, [1, 2, 3, 0]])
        quaternions = (Rotation.from_matrix(turn) * quaternions).as_quat()[:, [3, 0, 1, 2]]
        placed = [
            positions @ torch.from_numpy(turn).float().T,
            torch.from_numpy(quaternions).float(),
            scales,
            opacities,
        ]
        colours = [*sh.split([1, 15], dim=1), materials[:3].T, *materials[3:]]
        made = Surfels(*placed, *colours, torch.ones(count, 3), *indirect.split([1, 15], dim=1))
        occluder = Occluder(Mesh(room.vertices @ turn.T, room.faces[:, ::-1]))
        seen = dataclasses.replace(camera, world_to_camera=pose)
        return render(made, environment, seen, torch.zeros(3), settings, 0.1, occluder)

    before = picture(np.eye(3), sh, indirect)
    after = picture(TURN.numpy(), turned(sh, TURN), turned(indirect, TURN))
    left = picture(TURN.numpy(), sh, indirect)
    covered = before.alpha > 0.1
    assert covered.any() and before.visibility[covered].eq(0).all() and after.visibility[covered].eq(0).all()
    # A few pixels may differ, where two surfels at the same depth change their order.
    assert ((after.color - before.color).abs().amax(dim=-1) < 1e-3).float().mean() > 0.99
    assert (left.color - before.color)[covered].abs().mean() > 0.02
