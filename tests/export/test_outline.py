"""Test fitting a mesh to the outlines in the rendered pictures."""

import numpy as np
import pytest
import torch
import trimesh

from refgs.camera import Camera
from refgs.export.outline import fit_to_outlines
from refgs.formats.mesh import Mesh
from refgs.geometry.mesh import smooth_normals
from refgs.render.renderer import Rendering

VOXEL, DISTANCE, FOCAL, SIDE = 0.02, 4.0, 300.0, 160


def cameras(count=12):
    found = []
    for i in range(count):
        z = -0.8 + 1.6 * (i + 0.5) / count
        back = np.array([np.cos(2.4 * i) * np.sqrt(1 - z * z), np.sin(2.4 * i) * np.sqrt(1 - z * z), z])
        right = np.cross([0, 0, 1], back)
        right /= np.linalg.norm(right)
        turn = np.stack([right, np.cross(right, back), -back])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, -turn @ (DISTANCE * back)
        found.append(Camera(str(i), SIDE, SIDE, FOCAL, FOCAL, SIDE / 2, SIDE / 2, pose))
    return found


def unit_sphere(camera):
    """Render the unit sphere: its alpha and nothing else."""
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5 - SIDE / 2
    edge = FOCAL / np.sqrt(DISTANCE**2 - 1)
    alpha = torch.from_numpy((edge - np.hypot(x, y) + 0.5).clip(0, 1).astype(np.float32))
    nothing = torch.zeros(SIDE, SIDE, 3)
    return Rendering(nothing, alpha, alpha, nothing)


def ball(radius):
    sphere = trimesh.creation.icosphere(4, radius)
    return Mesh(np.array(sphere.vertices), np.array(sphere.faces), smooth_normals(sphere.vertices, sphere.faces))


@pytest.mark.parametrize("radius", [0.965, 0.99, 1.0])
def test_a_mesh_grows_to_its_outlines(radius):
    grown = fit_to_outlines(ball(radius), unit_sphere, cameras(), VOXEL)
    reached = np.linalg.norm(grown.vertices, axis=1)
    assert abs(reached.mean() - 1) < 0.1 * VOXEL and reached.std() < 0.1 * VOXEL
    np.testing.assert_allclose(grown.normals, grown.vertices / reached[:, None], atol=0.04)


def test_what_sticks_out_is_pulled_in():
    mesh = ball(0.98)
    bump = mesh.vertices[:, 2] > 0.9
    mesh.vertices[bump] *= 1.05
    grown = fit_to_outlines(mesh, unit_sphere, cameras(24), VOXEL)
    reached = np.linalg.norm(grown.vertices, axis=1)
    assert abs(reached[~bump].mean() - 1) < 0.15 * VOXEL
    # If the bump moved outwards as far as the rest, it would end 2.5 voxels outside the sphere.
    assert reached[bump].mean() < 1 + VOXEL


def test_without_a_background_nothing_moves():
    def full(camera):
        return Rendering(None, torch.ones(SIDE, SIDE), None, None)

    def with_a_gap(camera):
        alpha = torch.ones(SIDE, SIDE)
        alpha[:6, :6] = 0
        return Rendering(None, alpha, None, None)

    mesh = ball(0.9)
    assert fit_to_outlines(mesh, full, cameras(3), VOXEL) is mesh
    assert fit_to_outlines(mesh, with_a_gap, cameras(3), VOXEL) is mesh
