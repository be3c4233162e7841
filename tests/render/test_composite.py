"""Test the blended normals of splats against those of a sphere."""

import numpy as np
import torch

from refgs.model.surfels import axes
from refgs.render.composite import blended_normals
from tests.makers.painted_ball import sphere_of_splats


def degrees(a, b):
    return np.degrees(np.arccos((a * b).sum(axis=1).clip(-1, 1)))


def tilted(splats, degrees_of_tilt):
    """Rotate each splat by about as many degrees about a random axis. Normals point to the outside, as those of a run do."""
    rng = np.random.default_rng(0)
    half = np.radians(degrees_of_tilt) / 2
    rotations = splats.rotations + half * rng.normal(size=splats.rotations.shape)
    splats.rotations = (rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype(np.float32)
    normals = axes(torch.from_numpy(splats.rotations))[2].numpy()
    splats.normals = normals * np.sign((normals * splats.positions).sum(axis=1, keepdims=True))
    return splats


def test_normals_that_disagree_are_blended():
    splats = tilted(sphere_of_splats(), 15)
    outside = splats.positions / np.linalg.norm(splats.positions, axis=1, keepdims=True)
    own, blended = splats.normals, blended_normals(splats)
    np.testing.assert_allclose(np.linalg.norm(blended, axis=1), 1, atol=1e-5)
    assert np.median(degrees(own, outside)) > 12
    assert np.median(degrees(blended, outside)) < 0.4 * np.median(degrees(own, outside))
    # They are the splats' own again when read: blending is not repeated on what was blended.
    splats.normals = blended
    np.testing.assert_allclose(blended_normals(splats), blended, atol=1e-6)


def test_normals_that_agree_stay():
    splats = tilted(sphere_of_splats(), 0)
    assert degrees(splats.normals, blended_normals(splats)).max() < 2


def test_a_back_keeps_its_own_side():
    # A sheet of two layers, half a splat apart, which face away from each other.
    rng = np.random.default_rng(1)
    splats = sphere_of_splats()
    count, spread = len(splats), float(np.median(splats.scales[:, :2]))
    up = np.where(np.arange(count) % 2, 1.0, -1.0)
    place = rng.uniform(-1, 1, (count, 2)) * spread * np.sqrt(count) / 4
    splats.positions = np.c_[place, up * spread / 4].astype(np.float32)
    splats.rotations = np.tile(np.float32([1, 0, 0, 0]), (count, 1))
    splats.normals = np.c_[np.zeros((count, 2)), up].astype(np.float32)
    np.testing.assert_allclose(blended_normals(splats), splats.normals, atol=1e-5)
