"""Textures for a mesh, baked from the splats around it."""

import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.ndimage import distance_transform_edt

from refgs.export.composite import Progress, composite
from refgs.export.occlusion import openness
from refgs.formats.mesh import Mesh
from refgs.formats.splats import Splats
from refgs.formats.tangents import vertex_tangents
from refgs.formats.textures import Textures

FINE = 3  # texels at least that a splat's standard deviation is long where splats are composited; between them textures are linear
_ROWS = 64  # of texels at a time
_BESIDE = [(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)]


def bake(mesh: Mesh, splats: Splats, size: int, progress: Progress = lambda done, total: None) -> Textures:
    """What the splats (`composite`) are at each texel's point of the mesh, and how open that is to light (`openness`).

    `mesh` has normals and uv (`unwrap`). Texels that a chart covers in part have the point of the mesh's plane beyond its edge.
    """
    coarse = _composited(mesh, splats, size, progress)
    tangents, signs = vertex_tangents(mesh)
    free, scene = openness(mesh), _flat(mesh, size)
    widths = (3, 1, 1, 1, 3)
    maps = [np.zeros((size, size, width) if width > 1 else (size, size), np.float32) for width in widths]
    color, metallic, roughness, occlusion, normal = maps
    mask = np.zeros((size, size), bool)
    for rows in _blocks(size):
        face, weights, _ = _rasterise(mesh, scene, size, rows)
        on = mask[rows] = face >= 0
        corners, weights, texels = mesh.faces[face[on]], weights[on], _enlarged(coarse, size, rows)[on]
        normals, tangent, open_ = (_mean(weights, x[corners]) for x in (mesh.normals, tangents, free[:, None]))
        bitangent = signs[corners[:, :1]].astype(np.float32) * np.cross(normals, tangent)
        color[rows][on], metallic[rows][on], roughness[rows][on] = texels[:, :3], texels[:, 3], texels[:, 4]
        occlusion[rows][on] = open_[:, 0]
        normal[rows][on] = _in_tangent_space(texels[:, 5:], tangent, bitangent, normals)
    _pad(maps, mask)
    return Textures(*maps, mask, specular=float(splats.constants.get("specular", 1.0) > 0))


def _composited(mesh: Mesh, splats: Splats, size: int, progress: Progress) -> np.ndarray:
    """Base colour, metallic, roughness, normal (C, C, 8), of as many texels C up to `size` as the splats need."""
    corners, uv = mesh.vertices[mesh.faces], mesh.uv[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    covered = np.abs(_area(uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0])).sum()
    texel = np.sqrt(area / max(covered, 1e-12)) / size
    deviation = float(np.median(splats.scales[:, :2].min(axis=1)))
    # Two charts, 1/128 apart, must not reach each other by the texel that each goes beyond its edge.
    coarse = min(size, max(int(np.ceil(size * FINE * texel / deviation)), min(size, 256)))
    scene, mask, found = _flat(mesh, coarse), np.zeros((coarse, coarse), bool), []
    for rows in _blocks(coarse):
        face, weights, points = _rasterise(mesh, scene, coarse, rows)
        on = mask[rows] = face >= 0
        found.append((points[on].astype(np.float32), _mean(weights[on], mesh.normals[mesh.faces[face[on]]])))
    points, normals = map(np.concatenate, zip(*found, strict=True))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    blended = np.zeros((coarse, coarse, 8), np.float32)
    blended[mask] = composite(splats, points, normals, progress)
    _pad([blended], mask)
    return blended


def _blocks(size: int) -> list[slice]:
    """All rows, some at a time."""
    return [slice(start, min(start + _ROWS, size)) for start in range(0, size, _ROWS)]


def _enlarged(picture: np.ndarray, size: int, rows: slice) -> np.ndarray:
    """Rows of a square picture (C, C, 8) that is enlarged to `size`, bilinearly."""
    place = ((np.arange(rows.start, rows.stop) + 0.5) * len(picture) / size - 0.5).clip(0, len(picture) - 1)
    above = place.astype(int)
    below, part = np.minimum(above + 1, len(picture) - 1), (place - above).astype(np.float32)[:, None, None]
    lines = picture[above] * (1 - part) + picture[below] * part
    return np.dstack([cv2.resize(lines[..., half], (size, len(lines))) for half in (slice(0, 4), slice(4, 8))])


def _pad(maps: list[np.ndarray], mask: np.ndarray) -> None:
    """Give each texel outside the mask the values of the nearest one in it."""
    nearest = distance_transform_edt(~mask, return_distances=False, return_indices=True)
    for rows in _blocks(len(mask)):
        for values in maps:
            values[rows] = values[tuple(nearest[:, rows])]


def _mean(weights: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.einsum("nk,nkc->nc", weights, values).astype(np.float32)


def _in_tangent_space(vectors: np.ndarray, *basis: np.ndarray) -> np.ndarray:
    """Unit vectors (N, 3) in terms of tangents, bitangents and normals (N, 3).

    A shader forms x·tangent + y·bitangent + z·normal from interpolated vectors that are neither of unit length nor
    orthogonal: what it needs is the solution, not three dot products.
    """
    a, b, c = basis
    across = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    volume = (a * across[:, 0]).sum(axis=1)
    regular = np.abs(volume) > 1e-3
    local = np.einsum("nkc,nc->nk", across, vectors) / np.where(regular, volume, 1)[:, None]
    local[~regular] = (0, 0, 1)
    # A normal below the horizon of the mesh cannot be encoded.
    local[:, 2] = np.maximum(local[:, 2], 0.05)
    return local / np.linalg.norm(local, axis=1, keepdims=True)


def _flat(mesh: Mesh, size: int) -> EmbreeScene:
    """The mesh's charts, in texels."""
    flat = np.concatenate([mesh.uv * size, np.zeros((len(mesh.uv), 1))], axis=1).astype(np.float32)
    scene = EmbreeScene()
    TriangleMesh(scene, flat, mesh.faces.astype(np.int32))
    return scene


def _rasterise(mesh: Mesh, scene: EmbreeScene, size: int, rows: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The face (R, S) at each texel's centre, or beside it, -1 where there is none, its barycentric weights (R, S, 3) and the point
    (R, S, 3): that of the face's plane where the centre lies beyond an edge, with the weights of the nearest texel on the face."""
    first, last = max(rows.start - 1, 0), min(rows.stop + 1, size)
    y, x = np.mgrid[first:last, :size].astype(np.float32) + np.float32(0.5)
    origins = np.stack([x, size - y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    hit = scene.run(origins, np.tile(np.float32([0, 0, -1]), (len(origins), 1)), output=1)
    face = np.where(hit["tfar"] < 1e30, hit["primID"], -1).reshape(x.shape)
    weights = np.stack([1 - hit["u"] - hit["v"], hit["u"], hit["v"]], axis=-1).reshape(*x.shape, 3)
    inside = face >= 0
    around, row, column = face.copy(), *np.indices(face.shape)
    for down, right in _BESIDE:
        r, c = (np.clip(i + d, 0, n - 1) for i, d, n in ((row, down, face.shape[0]), (column, right, size)))
        empty = (around < 0) & (face[r, c] >= 0)
        around[empty], weights[empty] = face[r, c][empty], weights[r, c][empty]
    keep = slice(rows.start - first, rows.stop - first)
    face, weights, inside = around[keep], weights[keep], inside[keep]
    corners = mesh.faces[face]
    points = np.einsum("rsk,rskc->rsc", weights, mesh.vertices[corners])
    beyond = (face >= 0) & ~inside
    uv = mesh.uv[corners[beyond]] * size
    place = origins.reshape(*x.shape, 3)[keep][beyond][:, :2]
    exact = _barycentric(place, uv, weights[beyond])
    points[beyond] = np.einsum("nk,nkc->nc", exact, mesh.vertices[corners[beyond]])
    return face, weights, points


def _barycentric(points: np.ndarray, corners: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Weights (N, 3) of triangles' corners (N, 3, 2) at points (N, 2) that need not lie inside; `otherwise` in slivers."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    c, area = points - corners[:, 0], _area(a, b)
    good = np.abs(area) > 0.05 * ((a * a).sum(axis=1) + (b * b).sum(axis=1))
    area = np.where(good, area, 1)
    s, t = _area(c, b) / area, _area(a, c) / area
    return np.where(good[:, None], np.stack([1 - s - t, s, t], axis=1), otherwise)


def _area(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The signed areas (N,) of parallelograms of plane vectors (N, 2)."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
