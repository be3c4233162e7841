"""Find which light directions the object blocks itself, by tracing rays against its mesh (Ref-Gaussian paper, §3.2)."""

import numpy as np
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from refgs.formats.mesh import Mesh
from refgs.geometry.bvh import Tree

_LIFT = 1.0  # height of a ray's start above the mesh, in mean edges: the mesh only approximates the surface
_PASSES = 3  # faces tested by a ray: it passes through two back faces at most


class Occluder:
    """Trace rays against a mesh that blocks light.

    Rays start at the height `lift` above the mesh, in the mesh's units. The mesh may have any size and position, because single-precision
    rays are traced relative to its centre and size.
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
        """Return the mesh's bounding volume hierarchy for CUDA, built at the first call."""
        if self._tree is None:
            self._tree = Tree(self.mesh, self._centre, self._size, self.lift / self._size, device)
        return self._tree

    def visible(self, points: np.ndarray, normals: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Trace a ray from each of the surface `points` (P, 3). Return bool (P,): true if the mesh does not block the ray.

        `normals` (P, 3) and `directions` (P, 3) are unit vectors, as in `meet`.
        """
        return self.meet(points, normals, directions)[0] < 0

    def meet(self, points: np.ndarray, normals: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Trace a ray from each of the surface `points` (P, 3) along its unit direction in `directions` (P, 3).

        Returns the first face that each ray hits (P,), −1 if none, and the barycentric weights of the hit (P, 3). Rays start `lift` above
        the surface, along the unit `normals` (P, 3). Points and `lift` are in the mesh's units. Rays are blocked only by the front of a
        face. They pass through the back of a face, because then the ray started below the mesh or came in through a hole of the mesh.
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


def mirror(directions, normals):
    """Reflect directions (P, 3) at surfaces with unit normals (P, 3)."""
    return directions - 2 * (directions * normals).sum(-1)[:, None] * normals
