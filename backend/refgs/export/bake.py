"""Bake a mesh's textures from the splats around it."""

from typing import cast

import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.ndimage import distance_transform_edt

from refgs.export.occlusion import openness
from refgs.formats.mesh import UnwrappedMesh
from refgs.formats.splats import Splats
from refgs.formats.tangents import vertex_tangents
from refgs.formats.textures import Textures
from refgs.render.composite import NORMAL, Progress, composite

# Resolution of compositing, in texels a standard deviation of a splat. Textures with more texels are interpolated.
FINE = 3
_ROWS = 64  # rows of texels at a time
_NEIGHBOURS = [(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)]


def bake(mesh: UnwrappedMesh, splats: Splats, size: int, progress: Progress = lambda done, total: None) -> Textures:
    """Bake the textures of a mesh, `size` texels on each side, from the splats around it.

    `refgs.render.composite` blends the splats at each texel's point on the mesh. This gives base colour, metallic, roughness and normal. It
    also gives doubt (see `Textures`), if the splats have it. `openness` gives occlusion. A texel just outside a chart (a connected piece of
    the uv layout) has a point on the plane of the nearest face. `progress` is called with the number of points done and their total.
    """
    coarse = _composited(mesh, splats, size, progress)
    tangents, signs = vertex_tangents(mesh)
    free, scene = openness(mesh), _uv_scene(mesh, size)
    widths = (3, 1, 1, 1, 3)
    maps = [np.zeros((size, size, width) if width > 1 else (size, size), np.float32) for width in widths]
    color, metallic, roughness, occlusion, normal = maps
    doubt = np.zeros((size, size), np.float32) if splats.doubt is not None else None
    mask = np.zeros((size, size), bool)
    for rows in _row_blocks(size):
        face, weights, _ = _rasterise(mesh, scene, size, rows)
        on = mask[rows] = face >= 0
        corners, weights, texels = mesh.faces[face[on]], weights[on], _enlarged_rows(coarse, size, rows)[on]
        normals, tangent, open_ = (_interpolate(weights, x[corners]) for x in (mesh.normals, tangents, free[:, None]))
        bitangent = signs[corners[:, :1]].astype(np.float32) * np.cross(normals, tangent)
        color[rows][on], metallic[rows][on], roughness[rows][on] = texels[:, :3], texels[:, 3], texels[:, 4]
        occlusion[rows][on] = open_[:, 0]
        normal[rows][on] = _in_tangent_space(texels[:, NORMAL], tangent, bitangent, normals)
        if doubt is not None:
            doubt[rows][on] = texels[:, 8]
    _pad([*maps, doubt] if doubt is not None else maps, mask)
    specular = float(splats.constants.get("specular", 1.0) > 0)
    return Textures(color, metallic, roughness, occlusion, normal, mask, specular, doubt)


def _composited(mesh: UnwrappedMesh, splats: Splats, size: int, progress: Progress) -> np.ndarray:
    """Blend the splats at each texel, as (C, C, K) with C at most `size`."""
    # Texels need not be finer than 1/FINE of a splat's standard deviation.
    corners, uv = mesh.vertices[mesh.faces], mesh.uv[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    covered = np.abs(_cross(uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0])).sum()
    texel = np.sqrt(area / max(covered, 1e-12)) / size
    deviation = float(np.median(splats.scales[:, :2].min(axis=1)))
    # At least 256 texels: charts are 1/128 apart, and each extends a texel beyond its edge.
    coarse = min(size, max(int(np.ceil(size * FINE * texel / deviation)), min(size, 256)))
    scene, mask, found = _uv_scene(mesh, coarse), np.zeros((coarse, coarse), bool), []
    for rows in _row_blocks(coarse):
        face, weights, points = _rasterise(mesh, scene, coarse, rows)
        on = mask[rows] = face >= 0
        found.append((points[on].astype(np.float32), _interpolate(weights[on], mesh.normals[mesh.faces[face[on]]])))
    points, normals = map(np.concatenate, zip(*found, strict=True))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    values = composite(splats, points, normals, progress)
    blended = np.zeros((coarse, coarse, values.shape[1]), np.float32)
    blended[mask] = values
    _pad([blended], mask)
    return blended


def _row_blocks(size: int) -> list[slice]:
    """Split the rows 0..`size` of a picture into slices of _ROWS rows."""
    return [slice(start, min(start + _ROWS, size)) for start in range(0, size, _ROWS)]


def _enlarged_rows(picture: np.ndarray, size: int, rows: slice) -> np.ndarray:
    """Return the given rows of a square picture, bilinearly enlarged to `size`."""
    place = ((np.arange(rows.start, rows.stop) + 0.5) * len(picture) / size - 0.5).clip(0, len(picture) - 1)
    above = place.astype(int)
    below, part = np.minimum(above + 1, len(picture) - 1), (place - above).astype(np.float32)[:, None, None]
    lines = picture[above] * (1 - part) + picture[below] * part
    parts = (
        lines[..., first : first + 4] for first in range(0, picture.shape[2], 4)
    )  # cv2 takes four channels at most
    return np.dstack([cv2.resize(part, (size, len(lines))) for part in parts])


def _pad(maps: list[np.ndarray], mask: np.ndarray) -> None:
    """Fill `maps` outside the mask (S, S) from the nearest texel inside, in place."""
    nearest = cast(np.ndarray, distance_transform_edt(~mask, return_distances=False, return_indices=True))
    for rows in _row_blocks(len(mask)):
        for values in maps:
            values[rows] = values[tuple(nearest[:, rows])]


def _interpolate(weights: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.einsum("nk,nkc->nc", weights, values).astype(np.float32)


def _in_tangent_space(vectors: np.ndarray, *basis: np.ndarray) -> np.ndarray:
    """Convert vectors (N, 3) to unit vectors in a skewed basis: tangents, bitangents and normals."""
    # A shader adds x·tangent + y·bitangent + z·normal. These are interpolated, so neither orthogonal nor of unit length: x, y and z solve a
    # linear system.
    a, b, c = basis
    across = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    volume = (a * across[:, 0]).sum(axis=1)
    regular = np.abs(volume) > 1e-3
    local = np.einsum("nkc,nc->nk", across, vectors) / np.where(regular, volume, 1)[:, None]
    local[~regular] = (0, 0, 1)
    # Tangent-space maps cannot encode a normal below the mesh's horizon.
    local[:, 2] = np.maximum(local[:, 2], 0.05)
    return local / np.linalg.norm(local, axis=1, keepdims=True)


def _uv_scene(mesh: UnwrappedMesh, size: int) -> EmbreeScene:
    """Make a ray-tracing scene of the mesh's flat uv layout, in texels."""
    flat = np.concatenate([mesh.uv * size, np.zeros((len(mesh.uv), 1))], axis=1).astype(np.float32)
    scene = EmbreeScene()
    TriangleMesh(scene, flat, mesh.faces.astype(np.int32))
    return scene


def _rasterise(
    mesh: UnwrappedMesh, scene: EmbreeScene, size: int, rows: slice
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the face and the point of the mesh for each texel in `rows` of a texture. R is the number of rows, S is `size`.

    Returns three arrays: the index of the face (R, S), −1 where there is none; the barycentric weights in the face (R, S, 3); and the point
    (R, S, 3). `scene` is the result of `_uv_scene`.

    A texel just outside a chart copies the face and the weights of a neighbour inside. Its point is not copied, but computed at the texel's
    own place on the plane of the face. So the weights of such a texel do not give its point.
    """
    first, last = max(rows.start - 1, 0), min(rows.stop + 1, size)
    y, x = np.mgrid[first:last, :size].astype(np.float32) + np.float32(0.5)
    origins = np.stack([x, size - y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    hit = scene.run(origins, np.tile(np.array([0, 0, -1], np.float32), (len(origins), 1)), output=1)
    face = np.where(hit["tfar"] < 1e30, hit["primID"], -1).reshape(x.shape)
    weights = np.stack([1 - hit["u"] - hit["v"], hit["u"], hit["v"]], axis=-1).reshape(*x.shape, 3)
    inside = face >= 0
    around, row, column = face.copy(), *np.indices(face.shape)
    for down, right in _NEIGHBOURS:
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


def _barycentric(points: np.ndarray, corners: np.ndarray, fallback: np.ndarray) -> np.ndarray:
    """Compute barycentric weights (N, 3) of 2D points, or `fallback` in very thin triangles."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    c, area = points - corners[:, 0], _cross(a, b)
    good = np.abs(area) > 0.05 * ((a * a).sum(axis=1) + (b * b).sum(axis=1))
    area = np.where(good, area, 1)
    s, t = _cross(c, b) / area, _cross(a, c) / area
    return np.where(good[:, None], np.stack([1 - s - t, s, t], axis=1), fallback)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute the 2D cross products (N,) of vectors (N, 2)."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
