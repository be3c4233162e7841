"""Test the comparison of a reconstructed mesh with the true mesh."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from refgs.compare import surface
from refgs.formats.mesh import Mesh
from tests.makers.distances import look_at


def ball(radius=1.0):
    sphere = trimesh.creation.icosphere(5, radius)
    return Mesh(np.array(sphere.vertices), np.array(sphere.faces))


def camera(axis, distance=6.0):
    """Place a camera at `distance` along an axis, looking at the origin."""
    return replace(look_at(distance * np.asarray(axis), 64), fx=100.0, fy=100.0)


ALL_ROUND = [camera(sign * axis) for axis in np.eye(3) for sign in (1, -1)]


@pytest.fixture(autouse=True)
def fewer_points(monkeypatch):
    monkeypatch.setattr(surface, "POINTS", 10_000)


def test_balls_of_nearly_one_radius_are_apart_by_the_difference():
    figures = surface.compare(ball(1.01), ball(), ALL_ROUND)
    assert figures["chamfer"] == pytest.approx(0.01, rel=0.02)
    assert figures["normal_consistency"] > 0.999
    # Errors are relative to the true mesh's radius, so a scene four times as large has the same figures.
    larger = [camera(c.position / 6, 24.0) for c in ALL_ROUND]
    assert surface.compare(ball(4.04), ball(4.0), larger) == pytest.approx(figures, rel=1e-3)


def test_the_same_mesh_is_nowhere_off_however_it_is_cut_into_triangles():
    box = trimesh.creation.box((1, 1.2, 0.8))
    fine = box.subdivide().subdivide().subdivide().subdivide()
    meshes = [Mesh(np.array(m.vertices), np.array(m.faces)) for m in (box, fine)]
    figures = surface.compare(*meshes, ALL_ROUND)
    assert figures["chamfer"] < 1e-4 and figures["normal_consistency"] > 0.995


def test_what_no_camera_sees_is_left_out():
    truth, inner, above = ball(), ball(0.4), camera([0, 0, 1])
    faces = np.concatenate([truth.faces, inner.faces + len(truth.vertices)])
    hollow = Mesh(np.concatenate([truth.vertices, inner.vertices]), faces)
    assert surface.compare(hollow, truth, ALL_ROUND)["chamfer"] < 1e-3
    # A camera above sees only the upper half, so half a ball has no error there.
    half = Mesh(truth.vertices, truth.faces[truth.vertices[truth.faces][..., 2].min(axis=1) > -0.05])
    assert surface.compare(half, truth, [above])["chamfer"] < 1e-3
    assert surface.compare(half, truth, ALL_ROUND)["chamfer"] > 0.05
    turned = replace(above, world_to_camera=np.diag([-1.0, 1, -1, 1]) @ above.world_to_camera)
    assert surface.compare(truth, truth, [turned]) == {}, "it looks away"


def test_seen_points_are_those_on_the_cameras_side():
    mesh = ball()
    points = mesh.vertices
    seen = surface.seen(mesh, points, [camera([1, 0, 0])], 1e-3)
    assert seen[points[:, 0] > 1 / 6 + 0.05].all() and not seen[points[:, 0] < 1 / 6 - 0.05].any()
    near = surface.seen(mesh, points, [camera([1, 0, 0], 2.0)], 1e-3)
    # The field of view ends at a tangent of 0.32 at the sides and 0.45 in the corners. Points outside it are not seen.
    aside = np.linalg.norm(points[:, 1:], axis=1) / (2.0 - points[:, 0])
    assert near[(points[:, 0] > 0.6) & (aside < 0.31)].all() and not near[aside > 0.46].any()
