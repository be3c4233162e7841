"""Test the correction that removes shadows from the learned base colours."""

import numpy as np
import pytest
import torch
import trimesh

from refgs.export.unshadowed import LEAST, unshadowed
from refgs.model.surfels import to_splats
from tests.makers.occluders import as_occluder, bowl, even, mirrors, surfels


@pytest.mark.parametrize("albedo", [0.1, 0.5, 0.8])
def test_the_shadow_of_a_bowl_goes(albedo, monkeypatch):
    """Check that base colours learned inside a bowl are corrected to the true albedo. Metals keep their base colour.

    A point of the bowl receives the light x = 1/2 + albedo · x / 2, so its base colour is learned as albedo · x.
    """
    occluder, points, normals = bowl()
    mirrors(monkeypatch, 0.0)
    seen = surfels(points, normals, albedo * 0.5 / (1 - albedo / 2))
    found = unshadowed(to_splats(seen), seen, occluder.mesh, even(2.0))
    assert np.abs(found.albedo / albedo - 1).mean() < 0.05
    metal = seen._replace(metallic=torch.ones(len(points)))
    same = unshadowed(to_splats(metal), metal, occluder.mesh, even(2.0))
    np.testing.assert_allclose(same.albedo, metal.albedo.numpy(), rtol=1e-6)


def test_what_is_convex_stays_as_it_is():
    ball = trimesh.creation.icosphere(4)
    seen = surfels(np.asarray(ball.vertices), np.asarray(ball.vertices), 0.6)
    found = unshadowed(to_splats(seen), seen, as_occluder(ball).mesh, even())
    assert np.abs(found.albedo - 0.6).max() < 0.01


def test_the_dark_is_not_made_white():
    """Check that base colours between two plates that nearly touch are multiplied by at most 1 / LEAST, the correction's limit."""
    low, high = (trimesh.creation.box((2, 2, 0.1)).apply_translation([0, 0, z]) for z in (-0.05, 0.11))
    seen = surfels(np.zeros((4, 3)), np.tile([0.0, 0.0, 1.0], (4, 1)), 0.1)
    found = unshadowed(to_splats(seen), seen, as_occluder(low, high.subdivide()).mesh, even())
    assert (found.albedo <= 0.1 / LEAST + 1e-6).all()
