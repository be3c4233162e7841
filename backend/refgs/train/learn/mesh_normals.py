"""Draw normals of rough paint to those of the mesh that reflections are traced on.

A rough surface shows its normal only by how bright it is, and its base colour explains this as well. So a painted pattern gets into the
normals. It does not get into the mesh, whose surface is where photos agree on depth. Mirrored light tells normals better than a mesh does:
the narrower the lobe of the surface, the better. So the mesh counts in proportion to the lobe's width, which is roughness².

Photos tell depth to a part of a pixel only. So the mesh is wavy where it should be flat, by ten degrees. Its normals are denoised first.
"""

import numpy as np
from torch import Tensor

from refgs.formats.mesh import SmoothMesh
from refgs.geometry.mesh import denoised_normals
from refgs.geometry.visibility import Occluder
from refgs.train.learn.told_normals import ToldNormals
from refgs.train.part import Part
from refgs.train.state import State
from refgs.train.timeline import Step


class MeshNormals(Part):
    """Hold the normals of the mesh `of`, by the view's index. Each view is looked at when it is trained on."""

    name = "mesh normals"

    def start(self, state: State) -> None:
        self.of: Occluder | None = None
        self.views: dict[int, ToldNormals] = {}

    def told(self, state: State, mesh: Occluder, view: int) -> ToldNormals:
        """Return the normals of a mesh in a view."""
        with state.clock.part("mesh"):
            if self.of is not mesh:
                self.of, self.views = mesh, {}
                vertices, faces = mesh.mesh.vertices, mesh.mesh.faces
                self.surface = SmoothMesh(vertices, faces, denoised_normals(vertices, faces))
            if view not in self.views:
                known = np.ones(len(self.surface.vertices), bool)
                self.views[view] = ToldNormals.of(self.surface, mesh, known, state.photos[view].camera, state.device)
        return self.views[view]


def loss(state: State, step: Step) -> Tensor | None:
    """Compute how far this step's normals of rough paint are from the mesh's, a scalar. Return None without a mesh."""
    weight, mesh = state.losses.mesh, state.occluder
    if weight == 0 or mesh is None:
        return None
    told = state.part(MeshNormals).told(state, mesh, step.view)
    return told.loss(step, weight, lambda metallic, roughness: (1 - metallic) * roughness**2)
