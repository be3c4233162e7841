"""Tell normals from masks: where an object's visual hull touches it, both have the same normal.

The hull is bounded by rays through outlines of the masks. Each of them touches the object. Where the hull is round, it does so near one
point, and there the surface is. Where a ray runs along the hull, as over a bowl, a flat top or a fillet, it may touch the object anywhere.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from refgs.camera import Camera
from refgs.formats.mesh import Mesh, SmoothMesh
from refgs.geometry.project import inside, pixel_rays, project
from refgs.geometry.shape import fitted
from refgs.geometry.visibility import Occluder

ACROSS = 200  # pixels across the object, in reduced masks and where normals are looked up
TOUCHED = 1.0  # pixels from an outline, within which a ray touches the object
LONG = 0.12  # of the hull's radius: half of the longest way that a ray may run along a surface that is known


def ball(hull: Mesh) -> tuple[np.ndarray, float]:
    """Return the centre (3,) and the radius of a ball around a mesh."""
    low, high = hull.vertices.min(axis=0), hull.vertices.max(axis=0)
    return (low + high) / 2, float(np.linalg.norm(high - low)) / 2


def told(hull: SmoothMesh, alphas: Sequence[np.ndarray], cameras: Sequence[Camera]) -> np.ndarray:
    """Tell at which vertices of a visual hull (V,) the object's surface is: bool.

    `alphas` are the masks (H, W), uint8. A ray touches a vertex that it passes through if an outline lies within TOUCHED pixels. Its way
    is measured one edge below the surface, from the vertex to where it leaves the hull, to both sides. Of all rays that touch a vertex,
    the longest way counts: over a flat top, rays of higher cameras pass close by, too, and these are short.
    """
    centre, radius = ball(hull)
    within = Occluder(Mesh(hull.vertices, hull.faces[:, ::-1]))  # its faces block rays that leave the hull
    longest = np.full(len(hull.vertices), -1.0)
    for alpha, full in zip(alphas, cameras, strict=True):
        camera = fitted(full, centre, radius, ACROSS)
        solid = cv2.resize(alpha, (camera.width, camera.height), interpolation=cv2.INTER_AREA) > 127
        inner, outer = (cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, 5) for part in (solid, ~solid))
        apart = inner + outer - 0.5
        pixels, depth = project(camera, hull.vertices)
        seen = np.flatnonzero(inside(camera, pixels, depth))
        column, row = np.minimum(pixels[seen].astype(int), (camera.width - 1, camera.height - 1)).T
        touched = seen[apart[row, column] < TOUCHED]
        points, inward = hull.vertices[touched], -hull.normals[touched]
        rays = points - camera.position
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        way = np.zeros(len(touched))
        for direction in (rays, -rays):
            face, weights = within.meet(points, inward, direction)
            corners = within.mesh.vertices[within.mesh.faces[face]]
            left = np.linalg.norm(np.einsum("pka,pk->pa", corners, weights) - points, axis=1)
            way += np.where(face >= 0, left, 0) / 2
        longest[touched] = np.maximum(longest[touched], way)
    return (longest >= 0) & (longest < LONG * radius)


def normals_in(
    hull: SmoothMesh, surface: Occluder, known: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find a hull's normals in a picture, where they are known: rows (K,), columns (K,) and unit normals (K, 3), towards the outside.

    `surface` traces rays against the hull. `known` (V,), bool, tells at which vertices normals are known.
    """
    rows, columns = np.indices((camera.height, camera.width)).reshape(2, -1)
    rays = pixel_rays(camera, rows, columns)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    face, weights = surface.meet(np.broadcast_to(camera.position, rays.shape), rays, rays)
    found = np.flatnonzero((face >= 0) & known[hull.faces[face]].all(axis=1))
    normals = np.einsum("pka,pk->pa", hull.normals[hull.faces[face[found]]], weights[found])
    return rows[found], columns[found], normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
