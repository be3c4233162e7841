"""Measure ambient occlusion at a mesh's vertices."""

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from refgs.formats.mesh import SmoothMesh

RAYS = 64
_LIFT = 1e-3  # height of rays' start above the mesh, as a part of its size
_CHUNK = 1 << 14  # vertices at a time


def openness(mesh: SmoothMesh) -> np.ndarray:
    """Compute ambient occlusion at each vertex (V,): the fraction of a uniform light that the mesh does not block.

    The value 1 means that nothing blocks the light, as in glTF. RAYS rays start at each vertex. Their density is proportional to the cosine
    of the angle to the normal.
    """
    middle = mesh.vertices.mean(axis=0)  # subtracted, because rays are traced in single precision
    vertices = (mesh.vertices - middle).astype(np.float32)
    scene = EmbreeScene()
    TriangleMesh(scene, vertices, mesh.faces.astype(np.int32))
    # Points of a spiral over the disc, lifted to the hemisphere, have the density of the cosine.
    place = np.arange(RAYS) + 0.5
    radius, turn = np.sqrt(place / RAYS), place * np.pi * (3 - 5**0.5)
    hemisphere = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.sqrt(1 - radius**2)], axis=1)
    normals = mesh.normals
    across = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
    frames = np.stack([across, np.cross(normals, across), normals], axis=1)
    lift = _LIFT * np.linalg.norm(np.ptp(vertices, axis=0))
    free = np.empty(len(vertices), np.float32)
    for start in range(0, len(vertices), _CHUNK):
        at = slice(start, start + _CHUNK)
        rays = (hemisphere @ frames[at]).astype(np.float32)
        origins = np.repeat(vertices[at] + (lift * normals[at]).astype(np.float32), RAYS, axis=0)
        free[at] = (scene.run(origins, rays.reshape(-1, 3)) < 0).reshape(-1, RAYS).mean(axis=1)
    return free
