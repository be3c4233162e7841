"""Measure the errors of a mesh against the true one."""

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs

from refgs.camera import Camera
from refgs.formats.mesh import Mesh

POINTS = 100_000  # on each mesh, evenly by area
_NEAREST = (
    4  # nearest samples, and as many nearest centres, whose triangles are searched for the nearest point of a mesh
)
_OFFSET = 1e-3  # distance of a ray's start from its point, in radii, so that it does not hit its own surface


def radius(mesh: Mesh) -> float:
    """Return the largest distance of a vertex from the centre of the mesh's bounding box."""
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    return float(np.linalg.norm(mesh.vertices - middle, axis=1).max())


def compare(mesh: Mesh, truth: Mesh, cameras: list[Camera]) -> dict[str, float]:
    """Measure how much a mesh differs from the true mesh. Both are in the same coordinates.

    Returns a dictionary:

    - chamfer: the mean distance from one surface to the other, in both directions, divided by the true mesh's `radius`
    - normal_consistency: the mean absolute cosine between the normals of the two surfaces

    POINTS samples are taken on each mesh. Samples that no camera sees are left out, because photos do not show that part of the surface. A
    sample is also unseen if its own mesh hides it. Each visible sample is compared with the nearest point on the other mesh, visible or
    not. If one of the meshes has no visible sample, the dictionary is empty.
    """
    unit = radius(truth)
    samples = []
    for one in (mesh, truth):
        solid = trimesh.Trimesh(one.vertices, one.faces, process=False)
        points, face = trimesh.sample.sample_surface(solid, POINTS, seed=0)[:2]
        samples.append((solid, np.asarray(points), face, seen(one, points, cameras, _OFFSET * unit)))
    if not all(visible.any() for *_, visible in samples):
        return {}
    both = [_to_nearest(a, b) for a, b in (samples, reversed(samples))]
    distance, consistency = np.mean(both, axis=0)
    return {"chamfer": float(distance / unit), "normal_consistency": float(consistency)}


def seen(mesh: Mesh, points: np.ndarray, cameras: list[Camera], offset: float) -> np.ndarray:
    """Return bool (P,): true for the `points` (P, 3) on a mesh that at least one camera sees.

    A camera sees a point if the point is in its picture, and if the mesh does not hide it.

    Rays run from the points to the cameras. Each ray starts at the distance `offset` from its point, so that it does not hit the surface
    there.
    """
    middle = mesh.vertices.mean(axis=0)  # Embree traces in float32: centre the mesh
    scene = EmbreeScene()
    TriangleMesh(scene, (mesh.vertices[mesh.faces] - middle).astype(np.float32))
    found = np.zeros(len(points), bool)
    for camera in cameras:
        unseen = np.flatnonzero(~found)
        x, y, z = (points[unseen] @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]).T
        depth = np.where(z > 0, z, np.inf)
        u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
        unseen = unseen[(z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)]
        # Trace towards the camera, from a little nearer to it, so that a ray does not hit the surface it starts on.
        direction = camera.position - points[unseen]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        origins = (points[unseen] - middle + offset * direction).astype(np.float32)
        found[unseen] = scene.run(origins, direction.astype(np.float32)) < 0
    return found


def _to_nearest(sample: tuple, other: tuple) -> tuple[float, float]:
    """Compare the visible samples of one mesh with the nearest points on another mesh.

    Returns the mean distance, and the mean absolute cosine between the faces' normals. Each argument is a tuple of a mesh, points on it,
    the points' faces, and a mask of the visible points.
    """
    solid, points, face, visible = sample
    points, normals = points[visible], solid.face_normals[face[visible]]
    target, targets, target_face, _ = other
    # Between samples alone, even equal meshes would be half a spacing apart, so the nearest point is searched in triangles. Samples find
    # triangles larger than their spacing, centres find smaller ones.
    centres = target.triangles_center
    candidates = np.hstack(
        [
            target_face[cKDTree(targets).query(points, k=_NEAREST)[1]],
            cKDTree(centres).query(points, k=min(_NEAREST, len(centres)))[1].reshape(len(points), -1),
        ]
    )
    nearest = trimesh.triangles.closest_point(
        target.triangles[candidates.ravel()], np.repeat(points, candidates.shape[1], axis=0)
    )
    distance = np.linalg.norm(nearest.reshape(*candidates.shape, 3) - points[:, None], axis=-1)
    rows, best = np.arange(len(points)), distance.argmin(axis=1)
    cosine = np.abs((normals * target.face_normals[candidates[rows, best]]).sum(-1))
    return float(distance[rows, best].mean()), float(cosine.mean())
