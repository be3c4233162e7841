"""Compare ray-traced visibility with formulas, for simple shapes that are huge, tiny or far from the origin."""

import numpy as np
import pytest
import trimesh

from tests.makers.occluders import as_occluder, inside, plate

FRAMES = [(1.0, 0.0), (1e-3, 0.0), (1e3, 0.0), (1.0, 1e4)]


def directions(count: int, seed: int = 0) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize(("scale", "moved"), FRAMES)
def test_nothing_is_hidden_on_a_sphere(scale, moved):
    """Check that a sphere does not occlude itself: rays from its points are free if they rise at least one degree above the surface.

    The points lie on an exact sphere. The radius of its mesh is 99 %, 100 % or 101 % of the exact radius.
    """
    normals, towards = directions(20_000), directions(20_000, seed=1)
    tangent = np.cross(normals, towards)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    angle = np.radians(np.random.default_rng(2).uniform(1, 90, len(normals)))[:, None]
    outward = np.cos(angle) * tangent + np.sin(angle) * normals
    for size in (0.99, 1.0, 1.01):
        occluder = as_occluder(trimesh.creation.icosphere(5, radius=size), scale=scale, moved=moved)
        assert occluder.visible(normals * scale + moved, normals, outward).all()


@pytest.mark.parametrize(("scale", "moved"), FRAMES)
def test_two_plates_that_face_each_other(scale, moved):
    """Check rays from the lower of two plates: exactly those that meet the upper plate are occluded."""
    occluder = as_occluder(plate(0.0, 1), plate(1.0, -1), scale=scale, moved=moved)
    rng = np.random.default_rng(3)
    points = np.concatenate([rng.uniform(-0.9, 0.9, (20_000, 2)), np.zeros((20_000, 1))], axis=1)
    ways = directions(20_000, seed=4)
    ways[:, 2] = np.abs(ways[:, 2]).clip(0.02)
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    lifted = occluder.lift / scale
    across = np.abs(points[:, :2] + ways[:, :2] / ways[:, 2:] * (1 - lifted)).max(axis=1)
    clear = np.abs(across - 1) > 1e-4 / scale * max(scale, moved * 1e-3)
    up = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    found = occluder.visible(points * scale + moved, up, ways)
    np.testing.assert_array_equal(found[clear], across[clear] > 1)
    assert 0.2 < found.mean() < 0.8


@pytest.mark.parametrize(("scale", "moved"), FRAMES)
def test_the_inside_of_a_bowl(scale, moved):
    """Check rays from the bottom of a half sphere: exactly those within 45° of its axis are free."""
    occluder = as_occluder(inside(0.0), scale=scale, moved=moved)
    ways = directions(20_000, seed=5)
    ways = ways[ways[:, 2] > 0.05]
    pole = np.tile([0.0, 0.0, -1.0], (len(ways), 1))
    found = occluder.visible(pole * scale + moved, -pole, ways)
    # Leave out directions near the rim: it is a polygon, and rays start slightly above the bottom.
    sharp = np.abs(ways[:, 2] - np.sqrt(0.5)) > 0.03
    np.testing.assert_array_equal(found[sharp], ways[sharp, 2] > np.sqrt(0.5))


def test_a_point_below_the_mesh_is_not_in_its_shadow():
    """Check that rays which leave a mesh from inside are not occluded by it.

    Surfels may lie inside the mesh, because it only approximates them.
    """
    normals = directions(2000)
    occluder = as_occluder(trimesh.creation.icosphere(5))
    assert occluder.visible(0.8 * normals, normals, normals).all()
