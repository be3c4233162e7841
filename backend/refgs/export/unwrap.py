"""Unwrap a mesh for textures: cut it into charts (flat pieces), and place the charts in the unit square."""

from dataclasses import dataclass

import numpy as np
import xatlas

from refgs.formats.mesh import Mesh, SmoothMesh, UnwrappedMesh

# Most triangles of a part. xatlas's time grows faster than linearly with a mesh's triangles, and it unwraps meshes in parallel.
PART = 800


@dataclass(frozen=True)
class Layout:
    """Hold measures of how good a mesh's uv layout is.

    - used: the fraction of the unit square that is filled
    - density: texels per surface area, relative to the mean of the mesh. Two values: the 5th and the 95th percentile over the surface.
    - bend: how much the uv layout changes the angles of triangles, in degrees. The mean is weighted by area.
    """

    used: float
    density: tuple[float, float]
    bend: float


def unwrap(mesh: SmoothMesh) -> UnwrappedMesh:
    """Compute uv for a mesh with xatlas, which cuts it into charts (flat pieces). Returns a new mesh.

    Charts are at least 1/128 of the unit square's side apart. Vertices on seams are doubled and keep their normals. xatlas is slow for
    large meshes. So the mesh is first split into parts of at most PART triangles; no chart crosses from one part to another.
    """
    atlas, parts = xatlas.Atlas(), []
    for part in _parts(mesh):
        vertices, faces = np.unique(mesh.faces[part], return_inverse=True)
        given = mesh.vertices[vertices], faces.reshape(-1, 3), mesh.normals[vertices]
        atlas.add_mesh(*(x.astype(kind) for x, kind in zip(given, (np.float32, np.uint32, np.float32), strict=True)))
        parts.append((part, vertices))
    pack = xatlas.PackOptions()
    pack.resolution = 1024
    pack.padding = 8
    atlas.generate(pack_options=pack)
    side = np.array([atlas.width, atlas.height]) / max(atlas.width, atlas.height)  # equal scale in u and v
    sources, uvs, faces, count = [], [], np.empty_like(mesh.faces), 0
    for i, (part, vertices) in enumerate(parts):
        source, corners, uv = atlas[i]
        faces[part] = corners.astype(np.int64) + count
        sources.append(vertices[source])
        uvs.append(uv * side)
        count += len(source)
    source = np.concatenate(sources)
    return UnwrappedMesh(mesh.vertices[source], faces, mesh.normals[source], np.concatenate(uvs))


def _parts(mesh: Mesh) -> list[np.ndarray]:
    """Halve the mesh into parts of at most PART triangles; return their face indices."""
    middle, done, left = mesh.vertices[mesh.faces].mean(axis=1), [], [np.arange(len(mesh.faces))]
    while left:
        part = left.pop()
        if len(part) <= PART:
            done.append(part)
            continue
        axis = np.ptp(middle[part], axis=0).argmax()
        order = part[np.argsort(middle[part, axis], kind="stable")]
        left += [order[len(order) // 2 :], order[: len(order) // 2]]
    return done


def layout(mesh: UnwrappedMesh) -> Layout:
    """Measure how good the uv layout of a mesh is, by the figures of `Layout`."""
    corners, uv = mesh.vertices[mesh.faces], mesh.uv[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    laid = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    density = laid / np.maximum(area, 1e-30) * area.sum() / laid.sum()
    order = np.argsort(density)
    share = np.cumsum(area[order]) / area.sum()
    low, high = (float(density[order][np.searchsorted(share, s)]) for s in (0.05, 0.95))
    bend = np.abs(_angles(corners) - _angles(uv)).mean(axis=1)
    return Layout(float(laid.sum()), (low, high), float(np.degrees((bend * area).sum() / area.sum())))


def _angles(corners: np.ndarray) -> np.ndarray:
    """Compute the angles (F, 3) of triangles (F, 3, 2 or 3) in radians."""
    after, before = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    lengths = np.linalg.norm(after, axis=-1) * np.linalg.norm(before, axis=-1)
    return np.arccos(np.clip((after * before).sum(axis=-1) / np.maximum(lengths, 1e-30), -1, 1))
