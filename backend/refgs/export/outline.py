"""Fit a mesh to the outlines of the object in renderings.

A mesh fused from depth maps is too small, by at least half a voxel. The reason is that surfels are partly transparent, so their blended
depth lies a little below the surface. Outlines against the background have no such error.
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.sparse import coo_matrix, diags, identity

from refgs.camera import Camera
from refgs.formats.mesh import Mesh, SmoothMesh
from refgs.geometry.mesh import smooth_normals
from refgs.render.renderer import Rendering
from refgs.spread import spread

VIEWS = 24  # cameras at most, evenly chosen
UPSAMPLING = 4  # of alpha, each way, so that outlines have subpixel precision
LARGEST_MOVE = 3.0  # largest displacement of a vertex, in voxels
SMOOTHING_STEPS = 4
ITERATIONS = 2  # the first moves all vertices by the median gap
PRIOR = 0.05  # weight of a zero displacement, in outline pixels: vertices off the outlines stay


def fit_to_outlines(
    mesh: SmoothMesh, render: Callable[[Camera], Rendering], cameras: Sequence[Camera], voxel: float
) -> SmoothMesh:
    """Move a mesh's vertices along their normals until its outlines match the object's outlines in renderings.

    `render` makes the rendering for a camera; at most VIEWS of the cameras are used. First all vertices move outwards by the same distance:
    the median gap between the mesh's outlines and the object's. Then each vertex on an outline of the mesh moves by the gap at the vertex.
    Vertices outside the object's outline move back inside.

    `voxel` is the size in world units of the voxels that the mesh was made from. No vertex moves by more than LARGEST_MOVE voxels. The mesh
    is returned unchanged if the renderings show no background around the object, or if most gaps are larger than LARGEST_MOVE + 1 voxels.
    """
    views = [(camera, _signed_distance(render(camera).alpha.numpy())) for camera in spread(cameras, VIEWS)]
    views = [(camera, distance) for camera, distance in views if (distance < 0).any() and (distance > 0).any()]
    smooth, most = _smoother(mesh), LARGEST_MOVE * voxel
    step = np.zeros(len(mesh.vertices))
    for iteration in range(ITERATIONS):
        moved = Mesh(mesh.vertices + step[:, None] * mesh.normals, mesh.faces)
        found = [_gaps(moved, camera, distance) for camera, distance in views]
        if not found or not sum(len(vertex) for vertex, _ in found):
            return mesh
        vertex, gap = (np.concatenate(part) for part in zip(*found, strict=True))
        near = np.abs(gap) <= most + voxel  # larger gaps are to other outlines, as of a hole in the background
        if near.mean() < 0.5:
            return mesh
        vertex, gap = vertex[near], gap[near]
        if iteration == 0:
            step += np.clip(np.median(gap), 0, most)
        else:
            total, count = (np.bincount(vertex, x, len(step)) for x in (gap.clip(-voxel, voxel), None))
            step += smooth(total) / (smooth(count.astype(float)) + PRIOR)
        vertices = mesh.vertices + step[:, None] * mesh.normals
        step -= smooth(_overshoot(vertices, views))
        step = step.clip(-most, most)
    vertices = mesh.vertices + step[:, None] * mesh.normals
    return SmoothMesh(vertices, mesh.faces, smooth_normals(vertices, mesh.faces))


def _overshoot(vertices: np.ndarray, views: list[tuple[Camera, np.ndarray]]) -> np.ndarray:
    """Return the vertices' largest distances (V,) outside the outlines of `_signed_distance`, in world units."""
    overshoot = np.zeros(len(vertices))
    for camera, distance in views:
        x, y, z = camera.world_to_camera[:3, :3] @ vertices.T + camera.world_to_camera[:3, 3:]
        x, y = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        seen = (z > 0) & (x > 0) & (x < camera.width) & (y > 0) & (y < camera.height)
        overshoot[seen] = np.maximum(overshoot[seen], -_look_up(distance, x[seen], y[seen]) * z[seen] / camera.fx)
    return overshoot


def _smoother(mesh: Mesh) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that smooths vertex values (V,) by averaging neighbours SMOOTHING_STEPS times."""
    a, b = np.concatenate([mesh.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]).T
    count = len(mesh.vertices)
    near = coo_matrix((np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, a])), (count, count)).tocsr() + identity(count)
    near = diags(1 / np.asarray(near.sum(axis=1)).ravel()) @ near

    def smooth(values: np.ndarray) -> np.ndarray:
        for _ in range(SMOOTHING_STEPS):
            values = near @ values
        return values

    return smooth


def _signed_distance(alpha: np.ndarray) -> np.ndarray:
    """Return the distance in pixels to `alpha`'s outline, negative outside, UPSAMPLING times as fine."""
    fine = cv2.resize(alpha, None, fx=UPSAMPLING, fy=UPSAMPLING, interpolation=cv2.INTER_LINEAR) >= 0.5
    inner, outer = (cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5) for mask in (fine, ~fine))
    return np.where(fine, inner - 0.5, 0.5 - outer) / UPSAMPLING


def _look_up(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Read an UPSAMPLING times enlarged picture at pixel positions of the original."""
    row, column = ((UPSAMPLING * v).astype(int) for v in (y, x))
    return picture[row.clip(0, len(picture) - 1), column.clip(0, picture.shape[1] - 1)]


def _gaps(mesh: Mesh, camera: Camera, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Measure the gap between two outlines: the mesh's, and the object's in a rendering.

    Returns two arrays with one entry for each pixel on the mesh's outline: the index of a vertex near the pixel, and the gap there in world
    units. A gap is positive if the mesh's outline lies inside the object's, and negative if outside. `distance` is the result of
    `_signed_distance` for the rendering.
    """
    scene = EmbreeScene()  # rays are traced in single precision about the mesh's middle
    middle = mesh.vertices.mean(axis=0)
    TriangleMesh(scene, (mesh.vertices - middle).astype(np.float32), mesh.faces.astype(np.int32))
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1).reshape(-1, 3)
    rays = rays @ camera.camera_to_world[:3, :3].T
    origins = np.tile(camera.position - middle, (len(rays), 1)).astype(np.float32)
    hit = scene.run(origins, rays.astype(np.float32), output=1)
    depth = np.where(hit["tfar"] < 1e30, hit["tfar"], np.inf).reshape(x.shape)  # rays have depth 1
    covered = np.isfinite(depth).astype(np.uint8)
    along = (covered > 0) & (cv2.erode(covered, np.ones((3, 3), np.uint8), borderValue=(1,)) == 0)
    # On average the centres of the outermost pixels lie half a pixel inside the outline.
    gap = (_look_up(distance, x[along], y[along]) - 0.5) * depth[along] / camera.fx
    return mesh.faces[hit["primID"].reshape(x.shape)[along], 0], gap
