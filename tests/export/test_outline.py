"""Test fitting a mesh to the outlines in the rendered pictures."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from refgs.export.outline import fit_to_outlines
from refgs.render.renderer import Rendering
from tests.makers.distances import around
from tests.makers.painted_ball import ball

VOXEL, DISTANCE, FOCAL, SIDE = 0.02, 4.0, 300.0, 160


def cameras(count=12):
    return [replace(view, fx=FOCAL, fy=FOCAL) for view in around(count, SIDE, DISTANCE)]


def unit_sphere(camera):
    """Render the alpha mask of the unit sphere. Colours and normals are zero."""
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5 - SIDE / 2
    edge = FOCAL / np.sqrt(DISTANCE**2 - 1)
    alpha = torch.from_numpy((edge - np.hypot(x, y) + 0.5).clip(0, 1).astype(np.float32))
    nothing = torch.zeros(SIDE, SIDE, 3)
    return Rendering(nothing, alpha, alpha, nothing)


@pytest.mark.parametrize("radius", [0.965, 0.99, 1.0])
def test_a_mesh_grows_to_its_outlines(radius):
    grown = fit_to_outlines(ball(4, radius), unit_sphere, cameras(), VOXEL)
    reached = np.linalg.norm(grown.vertices, axis=1)
    assert abs(reached.mean() - 1) < 0.1 * VOXEL and reached.std() < 0.1 * VOXEL
    np.testing.assert_allclose(grown.normals, grown.vertices / reached[:, None], atol=0.04)


def test_what_sticks_out_is_pulled_in():
    mesh = ball(4, 0.98)
    bump = mesh.vertices[:, 2] > 0.9
    mesh.vertices[bump] *= 1.05
    grown = fit_to_outlines(mesh, unit_sphere, cameras(24), VOXEL)
    reached = np.linalg.norm(grown.vertices, axis=1)
    assert abs(reached[~bump].mean() - 1) < 0.15 * VOXEL
    # If the bump moved outwards as far as the rest, it would end 2.5 voxels outside the sphere.
    assert reached[bump].mean() < 1 + VOXEL


@pytest.mark.parametrize("corner", [1.0, 0.0])
def test_without_a_background_nothing_moves(corner):
    """Check that a mesh is not moved if it covers the whole picture, or all but a small corner."""
    mesh, alpha = ball(4, 0.9), torch.ones(SIDE, SIDE)
    alpha[:6, :6] = corner
    assert fit_to_outlines(mesh, lambda camera: Rendering(None, alpha, None, None), cameras(3), VOXEL) is mesh
