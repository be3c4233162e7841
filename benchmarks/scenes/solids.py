"""Model meshes with signed distance functions.

A solid is a function that takes points (n, 3) and returns n signed distances, negative inside. `sculpt` turns a solid into a mesh.
Distances need not be exact, but must be smooth near the surface. Their gradients must not be much longer than 1.
"""

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.sparse import coo_array, diags_array
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from scripts.demo.shapes import Mesh

Solid = Callable[[np.ndarray], np.ndarray]
FAR = 0.25  # beyond the width of any blend


def ellipsoid(centre, radii) -> Solid:
    """Make an ellipsoid along the axes. Its distances are accurate near its surface."""
    centre, radii = np.asarray(centre, float), np.asarray(radii, float)

    def distance(points):
        scaled = (points - centre) / radii
        length = np.linalg.norm(scaled, axis=1)
        slope = np.linalg.norm(scaled / radii, axis=1)
        return length * (length - 1) / np.maximum(slope, 1e-9)

    return distance


def box(centre, half, round: float) -> Solid:
    """Make a box along the axes. `half` (3,) is half its size, and `round` the radius of its rounded edges."""
    centre, inner = np.asarray(centre, float), np.asarray(half, float) - round

    def distance(points):
        beyond = np.abs(points - centre) - inner
        return np.linalg.norm(beyond.clip(0), axis=1) + beyond.max(axis=1).clip(max=0) - round

    return distance


def ring(centre, axis, radius: float, thickness: float) -> Solid:
    """Make a torus about `axis`; `thickness` is its tube's radius."""
    centre, axis = np.asarray(centre, float), np.asarray(axis, float) / np.linalg.norm(axis)

    def distance(points):
        apart = points - centre
        height = apart @ axis
        return np.hypot(np.linalg.norm(apart - height[:, None] * axis, axis=1) - radius, height) - thickness

    return distance


def disc(centre, axis, radius: float, half: float, round: float) -> Solid:
    """Make a cylinder about `axis`. `half` is half its height, and `round` the radius of its rounded edges."""
    centre, axis = np.asarray(centre, float), np.asarray(axis, float) / np.linalg.norm(axis)

    def distance(points):
        apart = points - centre
        height = apart @ axis
        beyond = np.stack(
            [
                np.linalg.norm(apart - height[:, None] * axis, axis=1) - radius + round,
                np.abs(height) - half + round,
            ],
            axis=1,
        )
        return np.linalg.norm(beyond.clip(0), axis=1) + beyond.max(axis=1).clip(max=0) - round

    return distance


def sweep(path, radii) -> Solid:
    """Make a tube along a smooth curve through the points `path` (n, 3). Its ends are half balls.

    `radii` are the tube's radii at these points (n,), or one radius. Distances larger than FAR are returned as FAR.
    """
    path = np.asarray(path, float)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    curve, radius = CubicSpline(length, path), PchipInterpolator(length, np.broadcast_to(radii, len(path)))
    steps = np.linspace(0, length[-1], 128)
    tree = cKDTree(curve(steps))

    def distance(points):
        result = np.full(len(points), FAR)
        way, nearest = tree.query(points, distance_upper_bound=np.max(radii) + FAR)
        near = np.isfinite(way)
        points, along = points[near], steps[nearest[near]]
        for _ in range(2):  # Newton towards the foot of the perpendicular
            apart, tangent = points - curve(along), curve(along, 1)
            bend = (tangent**2).sum(1) - (apart * curve(along, 2)).sum(1)
            along = (along + (apart * tangent).sum(1) / np.maximum(bend, 0.3)).clip(0, length[-1])
        result[near] = (np.linalg.norm(points - curve(along), axis=1) - radius(along)).clip(max=FAR)
        return result

    return distance


def blend(width: float, *parts: Solid) -> Solid:
    """Unite solids; surfaces closer than `width` merge smoothly (a cubic smooth minimum)."""

    def distance(points):
        result = parts[0](points)
        for part in parts[1:]:
            other = part(points)
            near = (1 - np.abs(result - other) / width).clip(0)
            result = np.minimum(result, other) - width / 6 * near**3
        return result

    return distance


def carve(width: float, solid: Solid, *tools: Solid) -> Solid:
    """Subtract other solids, the `tools`, from a solid. Edges of the cuts are rounded over about `width`."""
    rest = blend(width, lambda points: -solid(points), *tools)
    return lambda points: -rest(points)


def placed(solid: Solid, centre, axes) -> Solid:
    """Turn a solid so that its axes point along the rows of `axes` (3, 3), which are unit vectors, and move its origin to `centre`."""
    centre, axes = np.asarray(centre, float), np.asarray(axes, float)
    return lambda points: solid((points - centre) @ axes.T)


def mirrored(solid: Solid) -> Solid:
    """Make a symmetric solid: replace the half at y < 0 by the mirror image of the half at y > 0."""
    return lambda points: solid(np.stack([points[:, 0], np.abs(points[:, 1]), points[:, 2]], axis=1))


def sculpt(solid: Solid, low, high, cell: float, material: int) -> Mesh:
    """Turn a solid into a triangle mesh. `low` and `high` (3,) are the corners of the box that is searched; edges are about `cell` long.

    Marching cubes make the triangles. Then vertices slide along the surface until triangles have similar sizes: uneven triangles would be
    visible in reflections. All faces get the material with the index `material`.
    """
    block = 4
    low = np.asarray(low, float) - 2 * cell
    blocks = np.ceil((np.asarray(high, float) + 2 * cell - low) / (block * cell)).astype(int)
    # Only blocks that the surface may cross are evaluated in full.
    centres = low + (np.stack(np.indices(blocks), -1) + 0.5) * (block * cell)
    coarse = solid(centres.reshape(-1, 3)).reshape(blocks)
    field = np.repeat(np.repeat(np.repeat(coarse, block, 0), block, 1), block, 2)
    near = np.repeat(np.repeat(np.repeat(np.abs(coarse) < 1.25 * block * cell, block, 0), block, 1), block, 2)
    field[near] = solid(low + np.argwhere(near) * cell)
    vertices, triangles, _, _ = marching_cubes(field, 0.0, spacing=(cell,) * 3, gradient_direction="descent")
    vertices = vertices.astype(float) + low
    edges = np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    shape = (len(vertices), len(vertices))
    neighbours = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=shape).tocsr()
    neighbours = diags_array(1 / neighbours.sum(axis=1)) @ neighbours
    tetrahedron = np.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], float)
    small = 1e-2 * cell
    for slide in (0.7,) * 6 + (0.0,):
        vertices = vertices + slide * (neighbours @ vertices - vertices)
        around = np.stack([solid(vertices + small * way) for way in tetrahedron], axis=1)
        slope = around @ tetrahedron / (4 * small)
        vertices = vertices - (around.mean(1) / np.maximum((slope**2).sum(1), 0.1))[:, None] * slope
    return Mesh(vertices, triangles.astype(np.int64), np.full(len(triangles), material))
