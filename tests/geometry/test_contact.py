"""Test where outlines tell that a surface is."""

import numpy as np
from scipy.ndimage import binary_erosion, minimum_filter

from refgs.geometry.contact import contact
from tests.makers.distances import around, box, depth, sphere
from tests.makers.textured import bowl, grid, half_ball

VIEWS = around(48, 128)


def boundary(sdf, hull):
    """Return the points of the hull's outermost voxels, and the least contact there or in a neighbour, in units of its radius."""
    shape = grid(hull)
    masks = [np.rint(255 * depth(camera, sdf)[1]).astype(np.uint8) for camera in VIEWS]
    touched = minimum_filter(contact(shape, masks, VIEWS), 3) / shape.ball[1]
    outermost = shape.solid & ~binary_erosion(shape.solid)
    return shape.low + (np.argwhere(outermost) + 0.5) * shape.voxel, touched[outermost]


def test_outlines_tell_where_a_ball_is():
    _, length = boundary(sphere, sphere)
    assert np.mean(length < 0.05) > 0.95


def test_outlines_do_not_tell_what_is_under_the_lid_of_a_bowl():
    points, length = boundary(bowl, half_ball)
    lid = (points[:, 2] > -0.05) & (np.linalg.norm(points[:, :2], axis=1) < 0.8)
    wall = (points[:, 2] < -0.2) & (np.linalg.norm(points, axis=1) > 0.95)
    assert np.mean(length[lid] > 0.05) > 0.9
    assert np.mean(length[wall] < 0.05) > 0.9


def test_outlines_do_not_tell_that_a_face_is_flat():
    points, length = boundary(box, box)
    face = (points[:, 2] > 0.57) & (np.abs(points[:, :2]) < [0.6, 0.3]).all(axis=1)
    edge = np.abs(points[:, 2] - 0.59) + np.abs(np.abs(points[:, 1]) - 0.49) < 0.04
    assert np.mean(length[face] > 0.05) > 0.9
    assert np.mean(length[edge] < 0.05) > 0.5
