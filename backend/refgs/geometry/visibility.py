"""Which ways are free of the object itself: rays traced against a mesh of it (paper §3.2)."""

import numpy as np
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from refgs.formats.mesh import Mesh
from refgs.geometry.bvh import Tree

_LIFT = 1.0  # of the mesh's mean edge: how far a ray starts above its surface, which the mesh only comes near to
_PASSES = 3  # faces that a ray looks at: behind two back faces, the third


class Occluder:
    """A mesh that stands in the way of light. Its vertices may be in any unit and anywhere: rays are traced in single
    precision about its centre, at its size. `lift` is how far above the surface they start."""

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
        """What a card traces rays against in place of Embree."""
        if self._tree is None:
            self._tree = Tree(self.mesh, self._centre, self._size, self.lift / self._size, device)
        return self._tree

    def visible(self, points: np.ndarray, normals: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Whether nothing is in the way (P,) of rays as `meet` takes them."""
        return self.meet(points, normals, directions)[0] < 0

    def meet(self, points: np.ndarray, normals: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What rays from `points` (P, 3) of the surface, in the mesh's own frame, meet first in unit `directions` (P, 3):
        the face (P,), -1 where there is none, and the weights of its corners (P, 3). `normals` (P, 3) are the surface's:
        rays start a little above it.

        Only the front of a face blocks. A ray that meets a back face first began below the mesh, or comes to its open
        side: it goes on.
        """
        lift = self.lift / self._size
        directions = np.ascontiguousarray(directions, np.float32)
        origins = ((points - self._centre) / self._size + lift * normals).astype(np.float32)
        face, weights = np.full(len(origins), -1, np.int32), np.zeros((len(origins), 3), np.float32)
        going = np.arange(len(origins))
        for _ in range(_PASSES):
            hit = self._scene.run(origins, directions, query="INTERSECT", output=True)
            facing = np.einsum("pa,pa->p", hit["Ng"], directions)
            met = hit["primID"] >= 0
            front = met & (facing < 0)
            face[going[front]] = hit["primID"][front]
            u, v = hit["u"][front], hit["v"][front]
            weights[going[front]] = np.stack([1 - u - v, u, v], axis=1)
            on = met & ~front
            if not on.any():
                break
            going, directions = going[on], directions[on]
            origins = origins[on] + (hit["tfar"][on, None] + 0.1 * lift) * directions
        return face, weights
