"""Find the directions that the object itself occludes, by rays against its mesh (paper §3.2)."""

import numpy as np
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from refgs.formats.mesh import Mesh
from refgs.geometry.bvh import Tree

_LIFT = 1.0  # height of a ray's start above the mesh, in mean edges: the mesh only approximates the surface
_PASSES = 3  # faces tested by a ray: it passes through two back faces at most


class Occluder:
    """Mesh that occludes light.

    Its scale and position are arbitrary: rays are traced in single precision relative to its centre and size. Rays start at the height
    `lift` above the mesh, in the mesh's units.
    """

    def __init__(self, mesh: Mesh):
        self.mesh = mesh
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        self._centre = (low + high) / 2
        self._size = max(float((high - low).max()) / 2, 1e-30)

        corners = mesh.vertices[mesh.faces]
        self.lift = _LIFT * float(np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1).mean())
        self._tree: Tree | None = None
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, ((corners - self._centre) / self._size).astype(np.float32))

    def tree(self, device: torch.device) -> Tree:
        """Return the tree that a CUDA card traces in place of Embree. The first call builds it."""
        if self._tree is None:
            self._tree = Tree(self.mesh, self._centre, self._size, self.lift / self._size, device)
        return self._tree

    def visible(self, points: np.ndarray, normals: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Trace the rays of `meet`. Return bool (P,): true where the mesh does not occlude the ray."""
        return self.meet(points, normals, directions)[0] < 0

    def meet(self, points: np.ndarray, normals: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Trace rays from surface `points` (P, 3), in the mesh's frame, along unit `directions` (P, 3).

        Returns the first face hit (P,), −1 for none, and the weights of its corners (P, 3). Rays start `lift` above the surface, along
        its `normals` (P, 3). Only fronts of faces occlude. A ray passes through a back face, because it started below the mesh or meets
        the mesh's open side.
        """
        lift = self.lift / self._size
        directions = np.ascontiguousarray(directions, np.float32)
        origins = ((points - self._centre) / self._size + lift * normals).astype(np.float32)
        face, weights = np.full(len(origins), -1, np.int32), np.zeros((len(origins), 3), np.float32)
        rays = np.arange(len(origins))
        for _ in range(_PASSES):
            hit = self._scene.run(origins, directions, query="INTERSECT", output=True)
            facing = np.einsum("pa,pa->p", hit["Ng"], directions)
            met = hit["primID"] >= 0
            front = met & (facing < 0)
            face[rays[front]] = hit["primID"][front]
            u, v = hit["u"][front], hit["v"][front]
            weights[rays[front]] = np.stack([1 - u - v, u, v], axis=1)
            back = met & ~front
            if not back.any():
                break
            rays, directions = rays[back], directions[back]
            origins = origins[back] + (hit["tfar"][back, None] + 0.1 * lift) * directions
        return face, weights
