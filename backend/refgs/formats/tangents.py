"""Compute tangents by the MikkTSpace method, as glTF demands and Blender does."""

import numpy as np

from refgs.formats.mesh import UnwrappedMesh


def vertex_tangents(mesh: UnwrappedMesh) -> tuple[np.ndarray, np.ndarray]:
    """Compute a unit tangent (V, 3) and a sign (V,) for each vertex, such that bitangent = sign · normal × tangent.

    Tangents point along increasing u. A vertex's tangent is the mean of its faces' tangents. Each of these is projected to the plane of the
    vertex's normal and weighted by the face's angle at the vertex (Mikkelsen 2008, "Simulation of Wrinkled Surfaces Revisited"). A vertex
    on a seam of the texture coordinates must exist once for each side of the seam, as `unwrap` makes it.
    """
    corners, uv = mesh.vertices[mesh.faces], mesh.uv[mesh.faces]
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    d1, d2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = d1[:, 0] * d2[:, 1] - d2[:, 0] * d1[:, 1]
    sign = np.where(area < 0, -1.0, 1.0)
    along = sign[:, None] * (d2[:, 1:] * e1 - d1[:, 1:] * e2)

    total = np.zeros_like(mesh.vertices)
    flips = np.zeros(len(mesh.vertices))
    for corner in range(3):
        vertex = mesh.faces[:, corner]
        normal = mesh.normals[vertex]
        here = corners[:, corner]
        before, after = (_unit(_flatten(corners[:, (corner + step) % 3] - here, normal)) for step in (2, 1))
        angle = np.arccos(np.clip((before * after).sum(1), -1, 1)) * (area != 0)
        tangent = angle[:, None] * _unit(_flatten(along, normal))
        for axis in range(3):
            total[:, axis] += np.bincount(vertex, tangent[:, axis], len(total))
        flips += np.bincount(vertex, angle * sign, len(total))
    # Where all faces are degenerate in uv, take an arbitrary tangent.
    smallest = np.eye(3)[np.abs(mesh.normals).argmin(1)]
    lost = np.linalg.norm(total, axis=1) < 1e-12
    total[lost] = _flatten(smallest, mesh.normals)[lost]
    return _unit(total), np.where(flips < 0, -1.0, 1.0)


def _flatten(vectors: np.ndarray, normals: np.ndarray) -> np.ndarray:
    return vectors - (vectors * normals).sum(1, keepdims=True) * normals


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)
