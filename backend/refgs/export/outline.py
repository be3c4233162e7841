"""A mesh brought out to the outlines that the renderer shows.

Surfels are many and faint: where a ray meets them lies inside the shell they make, which is what is seen against the background. A mesh
fused from depth is too small by that, half a voxel and more.
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.sparse import coo_matrix, diags, identity

from refgs.camera import Camera
from refgs.formats.mesh import Mesh
from refgs.geometry.mesh import smooth_normals
from refgs.render.renderer import Rendering

VIEWS = 24  # of the cameras, evenly
FINER = 4  # times a picture's pixels: to this outlines are told from alpha
MOST = 3.0  # voxels
ROUNDS = 4  # of smoothing
TURNS = 2  # of looking at the outlines: first all is moved by the median
PRIOR = 0.05  # pixels of an outline that what is not on one counts as


def bring_out(mesh: Mesh, render: Callable[[Camera], Rendering], cameras: Sequence[Camera], voxel: float) -> Mesh:
    """A mesh with its vertices moved along their normals: all by what its outlines lack in the median, those along outlines by what is
    lacking there, and none out of an outline. As it was where pictures do not show the object before a background. `voxel`, in world
    units, is how fine it was fused: none moves by more than three."""
    chosen = [cameras[i] for i in np.linspace(0, len(cameras) - 1, min(VIEWS, len(cameras))).astype(int)]
    views = [(camera, _inside(render(camera).alpha.numpy())) for camera in chosen]
    views = [(camera, inside) for camera, inside in views if (inside < 0).any() and (inside > 0).any()]
    smooth, most = _smoother(mesh), MOST * voxel
    step = np.zeros(len(mesh.vertices))
    for turn in range(TURNS):
        moved = Mesh(mesh.vertices + step[:, None] * mesh.normals, mesh.faces)
        found = [_lacking(moved, camera, inside) for camera, inside in views]
        if not found or not sum(len(vertex) for vertex, _ in found):
            return mesh
        vertex, lacking = (np.concatenate(part) for part in zip(*found, strict=True))
        near = np.abs(lacking) <= most + voxel  # farther is an outline of something else: a gap in the background
        if near.mean() < 0.5:
            return mesh
        vertex, lacking = vertex[near], lacking[near]
        if turn == 0:
            step += np.clip(np.median(lacking), 0, most)
        else:
            total, count = (np.bincount(vertex, x, len(step)) for x in (lacking.clip(-voxel, voxel), None))
            step += smooth(total) / (smooth(count.astype(float)) + PRIOR)
        vertices = mesh.vertices + step[:, None] * mesh.normals
        step -= smooth(_beyond(vertices, views))
        step = step.clip(-most, most)
    vertices = mesh.vertices + step[:, None] * mesh.normals
    return Mesh(vertices, mesh.faces, smooth_normals(vertices, mesh.faces))


def _beyond(vertices: np.ndarray, views: list[tuple[Camera, np.ndarray]]) -> np.ndarray:
    """How far (V,), in world units, vertices lie outside of the outlines, in the view where that is most."""
    beyond = np.zeros(len(vertices))
    for camera, inside in views:
        x, y, z = camera.world_to_camera[:3, :3] @ vertices.T + camera.world_to_camera[:3, 3:]
        x, y = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        seen = (z > 0) & (x > 0) & (x < camera.width) & (y > 0) & (y < camera.height)
        beyond[seen] = np.maximum(beyond[seen], -_at(inside, x[seen], y[seen]) * z[seen] / camera.fx)
    return beyond


def _smoother(mesh: Mesh) -> Callable[[np.ndarray], np.ndarray]:
    """What averages values (V,) with those of the vertices next to them, a few times: outlines are told to a part of a pixel only."""
    a, b = np.concatenate([mesh.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]).T
    count = len(mesh.vertices)
    near = coo_matrix((np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, a])), (count, count)).tocsr() + identity(count)
    near = diags(1 / np.asarray(near.sum(axis=1)).ravel()) @ near

    def smooth(values: np.ndarray) -> np.ndarray:
        for _ in range(ROUNDS):
            values = near @ values
        return values

    return smooth


def _inside(alpha: np.ndarray) -> np.ndarray:
    """How many pixels (h, w), FINER each way, it is to the outline; negative outside."""
    fine = cv2.resize(alpha, None, fx=FINER, fy=FINER, interpolation=cv2.INTER_LINEAR) >= 0.5
    inner, outer = (cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5) for mask in (fine, ~fine))
    return np.where(fine, inner - 0.5, 0.5 - outer) / FINER


def _at(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A picture FINER than pixels at pixel positions."""
    row, column = ((FINER * v).astype(int) for v in (y, x))
    return picture[row.clip(0, len(picture) - 1), column.clip(0, picture.shape[1] - 1)]


def _lacking(mesh: Mesh, camera: Camera, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each pixel along the mesh's outline in a view, a vertex that is there, and how far, in world units, the outline lies inside the
    one that is wanted."""
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
    along = (covered > 0) & (cv2.erode(covered, np.ones((3, 3), np.uint8), borderValue=1) == 0)
    # The centres of the outermost pixels lie half a pixel inside in the mean.
    lacking = (_at(inside, x[along], y[along]) - 0.5) * depth[along] / camera.fx
    return mesh.faces[hit["primID"].reshape(x.shape)[along], 0], lacking
