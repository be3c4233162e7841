"""Hold normals that a mesh tells in a view, and measure how far rendered normals are from them."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import cosine_similarity

from refgs.camera import Camera
from refgs.formats.mesh import SmoothMesh
from refgs.geometry import outlines
from refgs.geometry.shape import fitted
from refgs.geometry.visibility import Occluder
from refgs.render.rendering import SOLID
from refgs.train.timeline import Step

WRONG = 0.03  # 1 − cosine of 14°, at which what is told is as likely wrong as the surface


class ToldNormals(NamedTuple):
    """Hold what is told in a view: at K places, `plane` (K, 2), at distance 1 before the camera, unit `normals` (K, 3).

    `part` is a place's part of the picture's area.
    """

    plane: Tensor
    normals: Tensor
    part: float

    @staticmethod
    def of(
        mesh: SmoothMesh, surface: Occluder, known: np.ndarray, camera: Camera, device: torch.device
    ) -> "ToldNormals":
        """Find the normals of a mesh in a camera's view, where they are `known` (V,). `surface` traces rays against the mesh."""
        small = fitted(camera, *outlines.ball(mesh), outlines.ACROSS)
        rows, columns, normals = outlines.normals_in(mesh, surface, known, small)
        plane = np.stack([columns + 0.5 - small.cx, rows + 0.5 - small.cy], axis=1) / (small.fx, small.fy)
        at, outward = (torch.from_numpy(x.astype(np.float32)).to(device) for x in (plane, normals))
        return ToldNormals(at, outward, 1 / (small.width * small.height))

    def loss(self, step: Step, weight: float, trust: Callable[[Tensor, Tensor], Tensor]) -> Tensor | None:
        """Compute `weight` times how far a step's normals are from those told. Return None if the rendering has no material.

        The loss is a scalar: a mean over the pixels of the whole photo, also if only a crop is rendered. It saturates: t · e / (e + WRONG)
        at a place where 1 − the cosine is e. `trust` computes t from metallic and roughness, (K,) each.
        """
        rendering, camera = step.rendering, step.photo.camera
        if rendering.material is None:
            return None
        column = (self.plane[:, 0] * camera.fx + camera.cx).floor().long()
        row = (self.plane[:, 1] * camera.fy + camera.cy).floor().long()
        shown = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        at = row.clamp(0, camera.height - 1) * camera.width + column.clamp(0, camera.width - 1)
        # The derivative of index_select is a sum of rows, which is several times as fast as that of an index.
        alpha = rendering.alpha.detach().flatten().index_select(0, at)
        material = rendering.material.detach().flatten(0, 1).index_select(0, at)
        counts = shown * (alpha > SOLID) * trust(material[:, 3], material[:, 4])
        error = 1 - cosine_similarity(rendering.normal.flatten(0, 1).index_select(0, at), self.normals, dim=1)
        return weight * (self.part * (counts * error / (error + WRONG)).sum())
