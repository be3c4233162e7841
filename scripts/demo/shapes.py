"""Build an object's triangle mesh in numpy, with a material for each face."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator


@dataclass(frozen=True)
class Material:
    """Principled BSDF: linear Rec.709 base colour, metallic 0..1, perceptual roughness 0..1.

    A texture is a function from points (n, 3) to base colours (n, 3). It is evaluated at the vertices and interpolated linearly between
    them.
    """

    base_color: tuple[float, float, float] | Callable[[np.ndarray], np.ndarray]
    metallic: float
    roughness: float


@dataclass(frozen=True)
class Mesh:
    """Vertices (n, 3); triangles (m, 3), counter-clockwise seen from outside; material (m,), an index for each triangle."""

    vertices: np.ndarray
    triangles: np.ndarray
    material: np.ndarray


@dataclass(frozen=True)
class Scene:
    """Hold an object, which lies about the origin with Z up, and how it is photographed.

    `light` names one of Blender's HDRIs; `lowest` is the smallest z of a camera's direction from the origin.
    """

    mesh: Mesh
    materials: tuple[Material, ...]
    light: str
    lowest: float = -0.3


def moved(mesh: Mesh, by: tuple[float, float, float]) -> Mesh:
    """Move a mesh."""
    return Mesh(mesh.vertices + by, mesh.triangles, mesh.material)


def step(start: float, end: float, values: np.ndarray) -> np.ndarray:
    """Compute a smooth step that rises from 0 at `start` to 1 at `end`, for textures."""
    t = ((values - start) / (end - start)).clip(0, 1)
    return t * t * (3 - 2 * t)


def mix(one, other, share: np.ndarray) -> np.ndarray:
    """Mix two colours (n, 3): `share` (n,) is the weight of `other`, 0..1."""
    return np.asarray(one) + share[:, None] * (np.asarray(other) - np.asarray(one))


def join(*meshes: Mesh) -> Mesh:
    """Join meshes, which may intersect."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.triangles + offset for mesh, offset in zip(meshes, offsets, strict=True)]),
        np.concatenate([mesh.material for mesh in meshes]),
    )


def lathe(segments: list[tuple[int, list[tuple[float, float]]]], rows: int, columns: int, flutes=None) -> Mesh:
    """Rotate a profile about z, which makes a closed surface.

    `segments`: (material, [(radius, z), …]) from the lowest point on the axis to the highest. Each segment starts where the one before
    ended. A monotone cubic joins all points without overshooting. `flutes(angle, z)` returns factors of the radius.
    """
    points = np.array([point for _, segment in segments for point in segment])
    ends = np.cumsum([len(segment) for _, segment in segments])[:-1] - 1
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    # Rows fall exactly on the boundaries between segments, so that each material ends in a clean circle.
    knots = np.concatenate([[0.0], length[ends], length[-1:]])
    counts = np.maximum(2, np.round(rows * np.diff(knots) / length[-1]).astype(int))
    steps = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(knots[:-1], knots[1:], counts, strict=True)]
    radius, z = PchipInterpolator(length, points)(np.append(np.concatenate(steps), length[-1])).T
    angle = np.arange(columns) * (2 * np.pi / columns)
    scale = np.ones((1, columns)) if flutes is None else flutes(angle[None, :], z[1:-1, None])
    ring = radius[1:-1, None] * scale
    grid = np.stack([ring * np.cos(angle), ring * np.sin(angle), np.broadcast_to(z[1:-1, None], ring.shape)], -1)
    rings, first, last = len(grid), [[0.0, 0.0, z[0]]], [[0.0, 0.0, z[-1]]]
    top = rings * columns + 1
    here, following = 1 + np.arange(columns), 1 + np.roll(np.arange(columns), -1)
    bottom_cap = np.stack([np.zeros(columns, int), following, here], -1)
    top_cap = np.stack([np.full(columns, top), here + (rings - 1) * columns, following + (rings - 1) * columns], -1)
    body = 1 + _grid_triangles(rings - 1, columns)
    band = np.repeat([material for material, _ in segments], counts)
    material = np.concatenate(
        [np.full(columns, band[0]), np.repeat(band[1:-1], 2 * columns), np.full(columns, band[-1])]
    )
    return Mesh(
        np.concatenate([first, grid.reshape(-1, 3), last]), np.concatenate([bottom_cap, body, top_cap]), material
    )


def tube(path: np.ndarray, radius: float, material: int, closed: bool, rows: int = 128, columns: int = 32) -> Mesh:
    """Make a round tube along a cubic spline through the points `path` (n, 3), which lie in a plane. Open ends are not capped."""
    path = np.asarray(path, float)
    if closed:
        path = np.concatenate([path, path[:1]])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    spline = CubicSpline(length, path, bc_type="periodic" if closed else "not-a-knot")
    along = np.linspace(0.0, length[-1], rows, endpoint=not closed)
    centre, tangent = spline(along), spline(along, 1)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.linalg.svd(path - path.mean(0))[2][2]  # the plane's normal
    side = np.cross(across, tangent)
    angle = np.arange(columns) * (2 * np.pi / columns)
    grid = centre[:, None] + radius * (
        np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * across
    )
    triangles = _grid_triangles(rows if closed else rows - 1, columns) % (rows * columns)
    return Mesh(grid.reshape(-1, 3), triangles, np.full(len(triangles), material))


def _grid_triangles(bands: int, columns: int) -> np.ndarray:
    """Triangulate a grid whose last column joins its first, with two triangles for each cell. Returns indices (2·bands·columns, 3)."""
    row, column = np.meshgrid(np.arange(bands), np.arange(columns), indexing="ij")
    a, b = row * columns + column, row * columns + (column + 1) % columns
    c, d = b + columns, a + columns
    return np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], 2).reshape(-1, 3)
