"""Build triangle meshes in numpy, with a material for each triangle."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

Texture = Callable[[np.ndarray], np.ndarray]
"""From points (n, 3) to colours (n, 3) or numbers (n,). It is evaluated at the vertices and interpolated linearly between them."""


@dataclass(frozen=True)
class Material:
    """Hold values of a Principled BSDF: linear Rec.709 base colour, metallic 0..1, perceptual roughness 0..1. Each may be a texture.

    `brushed` is the anisotropy 0..1 of a surface that is brushed along circles about z: its highlights are stretched across these circles.
    """

    base_color: tuple[float, float, float] | Texture
    metallic: float | Texture
    roughness: float | Texture
    brushed: float | Texture = 0.0


@dataclass(frozen=True)
class Mesh:
    """Hold a triangle mesh: vertices (n, 3), triangles (m, 3), and for each triangle the index of its material (m,).

    Triangles are counter-clockwise seen from outside.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    material: np.ndarray


@dataclass(frozen=True)
class Scene:
    """Hold an object around the origin, with Z up, its light, and how low cameras may stand.

    `light` names one of Blender's HDRIs, or is a panorama (H, 2·H, 3) of linear radiance in Blender's orientation. The cameras stand on a
    sphere around the origin. None stands below the height `lowest`, given as a fraction of the sphere's radius (-1..1).
    """

    mesh: Mesh
    materials: tuple[Material, ...]
    light: str | np.ndarray
    lowest: float = -0.3


def moved(mesh: Mesh, by: tuple[float, float, float]) -> Mesh:
    """Return a copy of a mesh, translated by the vector `by`."""
    return Mesh(mesh.vertices + by, mesh.triangles, mesh.material)


def step(start: float, end: float, values: np.ndarray) -> np.ndarray:
    """Compute a smooth step: 0 up to `start`, 1 from `end` on, with a smooth rise between them (3t² − 2t³ for t in 0..1)."""
    t = ((values - start) / (end - start)).clip(0, 1)
    return t * t * (3 - 2 * t)


def mix(one, other, weight: np.ndarray) -> np.ndarray:
    """Blend two colours: `weight` (n,) is 0 for the colour `one` and 1 for the colour `other`. Returns (n, 3)."""
    return np.asarray(one) + weight[:, None] * (np.asarray(other) - np.asarray(one))


def join(*meshes: Mesh) -> Mesh:
    """Concatenate meshes into one. They may intersect; no face is cut or removed."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.triangles + offset for mesh, offset in zip(meshes, offsets, strict=True)]),
        np.concatenate([mesh.material for mesh in meshes]),
    )


def lathe(segments: list[tuple[int, list[tuple[float, float]]]], rows: int, columns: int, flutes=None) -> Mesh:
    """Make a closed surface of revolution: rotate a profile about z.

    `segments` lists the profile as (material, [(radius, z), …]), from the lowest point on the axis to the highest. A monotone cubic spline
    joins all points without overshooting. The material changes at the last point of each segment.

    `rows` is the number of steps along the profile, `columns` that around the axis. `flutes(angle, z)`, if given, returns factors that
    scale the radius.
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
    """Make a round tube along a cubic spline through the points `path` (n, 3), which lie in a plane.

    `material` is the index of its material. There are `rows` steps along the tube and `columns` around it. If `closed`, the tube returns to
    its start; otherwise its ends stay open.
    """
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
    """Triangulate a grid of `bands` × `columns` cells whose last column joins its first, as around a tube.

    Returns vertex indices (2·bands·columns, 3), two triangles for each cell. The vertices are numbered row by row.
    """
    row, column = np.meshgrid(np.arange(bands), np.arange(columns), indexing="ij")
    a, b = row * columns + column, row * columns + (column + 1) % columns
    c, d = b + columns, a + columns
    return np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], 2).reshape(-1, 3)
