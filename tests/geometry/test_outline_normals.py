"""Test which normals of a visual hull outlines tell."""

import numpy as np
import pytest

from refgs.geometry import outlines
from refgs.geometry.hull import visual_hull_points
from refgs.geometry.visibility import Occluder
from tests.makers.distances import around, depth, gradient, rays_of
from tests.makers.textured import BALL, bowl, on_a_disc

VIEWS = [camera for camera in around(80, 128) if camera.position[2] > 0.5]


def hull_of(sdf):
    """Return a shape's visual hull, and at which of its vertices outlines tell the surface."""
    masks = [np.rint(255 * depth(camera, sdf)[1]).astype(np.uint8) for camera in VIEWS]
    hull = visual_hull_points(masks, VIEWS, (0, 0, 0), 1.5, 500, resolution=144).surface
    return hull, outlines.told(hull, masks, VIEWS)


@pytest.fixture(scope="module")
def ball():
    return hull_of(on_a_disc)


def test_outlines_tell_the_normals_of_a_ball(ball):
    hull, known = ball
    away = np.linalg.norm(hull.vertices - BALL[0], axis=1) - BALL[1]
    upper = (np.abs(away) < 0.02) & (hull.vertices[:, 2] > BALL[0][2])
    assert known[upper].mean() > 0.9
    cosine = (hull.normals * gradient(on_a_disc, hull.vertices)).sum(axis=1)[upper & known]
    assert np.degrees(np.arccos(cosine.clip(-1, 1))).mean() < 8


def test_outlines_do_not_tell_that_a_disc_under_it_is_flat(ball):
    """Check the dome that the hull has over a disc, of which the lowest cameras see the top at a grazing angle."""
    hull, known = ball
    apart = np.linalg.norm(hull.vertices - BALL[0], axis=1)
    dome = (hull.vertices[:, 2] > 0.1) & (apart > 1.5 * BALL[1]) & (np.hypot(*hull.vertices[:, :2].T) < 0.8)
    assert known[dome].mean() < 0.1


def test_outlines_do_not_tell_the_normals_of_a_lid():
    hull, known = hull_of(bowl)
    lid = (hull.vertices[:, 2] > -0.05) & (np.linalg.norm(hull.vertices[:, :2], axis=1) < 0.7)
    assert known[lid].mean() < 0.05


def test_a_camera_sees_the_normals_of_the_ball(ball):
    hull, known = ball
    camera = VIEWS[12]
    away, hit = depth(camera, on_a_disc)
    points = camera.position + rays_of(camera) * away[..., None]
    rows, columns, normals = outlines.normals_in(hull, Occluder(hull), known, camera)
    upper = (hit > 0) & (points[..., 2] > BALL[0][2])
    seen = upper[rows, columns]
    assert seen.sum() > 0.8 * upper.sum()
    cosine = (normals * gradient(on_a_disc, points[rows, columns])).sum(axis=1)[seen]
    assert np.median(np.degrees(np.arccos(cosine.clip(-1, 1)))) < 8
