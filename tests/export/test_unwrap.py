"""Test UV unwrapping: charts cover the whole surface, do not overlap, and have an even texel density."""

import numpy as np
import pytest

from refgs.export.unwrap import PART, layout, unwrap
from refgs.formats.mesh import SmoothMesh, UnwrappedMesh
from refgs.geometry.mesh import smooth_normals
from tests.makers.painted_ball import ball


@pytest.fixture(scope="module")
def bumpy():
    """Make a wavy sphere. It has so many triangles that the unwrapping splits it into several parts."""
    sphere = ball(4)
    vertices = sphere.vertices * (1 + 0.15 * np.sin(5 * sphere.vertices).prod(axis=1, keepdims=True))
    return SmoothMesh(vertices, sphere.faces, smooth_normals(vertices, sphere.faces))


@pytest.fixture(scope="module")
def unwrapped(bumpy):
    return unwrap(bumpy)


def test_it_is_the_same_surface(bumpy, unwrapped):
    assert len(bumpy.faces) > 4 * PART
    assert unwrapped.uv.min() >= 0 and unwrapped.uv.max() <= 1
    np.testing.assert_array_equal(unwrapped.vertices[unwrapped.faces], bumpy.vertices[bumpy.faces])
    np.testing.assert_array_equal(unwrapped.normals[unwrapped.faces], bumpy.normals[bumpy.faces])


def test_nothing_overlaps(unwrapped):
    """Check that no point of the texture lies in two triangles, and that no triangle is flipped."""
    size, count = 1024, np.zeros((1024, 1024), int)
    for corners in unwrapped.uv[unwrapped.faces] * size:
        low, high = np.floor(corners.min(0)).astype(int), np.ceil(corners.max(0)).astype(int)
        x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
        a, b = corners[1] - corners[0], corners[2] - corners[0]
        area, x, y = a[0] * b[1] - a[1] * b[0], x - corners[0, 0], y - corners[0, 1]
        s, t = (x * b[1] - y * b[0]) / area, (y * a[0] - x * a[1]) / area
        inside = (s > 1e-3) & (t > 1e-3) & (s + t < 1 - 1e-3)
        count[low[1] : high[1], low[0] : high[0]] += inside
    assert count.max() == 1 and count.mean() > 0.3


def test_texels_are_even_and_angles_kept(unwrapped):
    found = layout(unwrapped)
    assert found.used > 0.35 and found.bend < 3
    assert found.density[0] > 0.65 and found.density[1] < 1.35


def test_stretch_is_told(unwrapped):
    one_way = UnwrappedMesh(unwrapped.vertices, unwrapped.faces, unwrapped.normals, unwrapped.uv * [1, 0.5])
    assert layout(one_way).bend > 10 and layout(one_way).used == pytest.approx(layout(unwrapped).used / 2)
