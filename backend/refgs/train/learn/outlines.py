"""Draw normals of metals to what outlines tell.

Photos of a mirror in a dark room hardly tell its normals, and the light gives way to wrong ones. Outlines tell them to a degree or two
wherever they show the surface (see `geometry.outlines`). Paint is not drawn: its own texture tells more than a hull, which has domes over
flat tops. A hull also bridges shallow relief, so the loss saturates where photos contradict.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import cosine_similarity

from refgs.formats.mesh import SmoothMesh
from refgs.geometry import outlines
from refgs.geometry.shape import fitted
from refgs.geometry.visibility import Occluder
from refgs.render.rendering import SOLID
from refgs.train.part import Part
from refgs.train.state import State
from refgs.train.timeline import Step

WRONG = 0.03  # 1 − cosine of 14°, at which outlines are as likely wrong as the surface


class Told(NamedTuple):
    """Hold what outlines tell in a view: at K places, `plane` (K, 2), at distance 1 before the camera, unit `normals` (K, 3).

    `part` is a place's part of the picture's area.
    """

    plane: Tensor
    normals: Tensor
    part: float


class Outlines(Part):
    """Hold what outlines tell, by the view's index."""

    name = "outlines"

    def start(self, state: State) -> None:
        self.told: dict[int, Told] = {}


def load(state: State, hull: SmoothMesh | None) -> None:
    """Find the normals of the visual hull in all training views, where outlines tell them."""
    if hull is None or not state.method.lit or state.settings.loss.outlines == 0:
        return
    with state.clock.part("start"):
        cameras = [view.camera for view in state.views]
        known = outlines.told(hull, [view.alpha for view in state.views if view.alpha is not None], cameras)
        around, surface, told = outlines.ball(hull), Occluder(hull), state.part(Outlines).told
        for index, camera in enumerate(cameras):
            small = fitted(camera, *around, outlines.ACROSS)
            rows, columns, normals = outlines.normals_in(hull, surface, known, small)
            plane = np.stack([columns + 0.5 - small.cx, rows + 0.5 - small.cy], axis=1) / (small.fx, small.fy)
            at, outward = (torch.from_numpy(x.astype(np.float32)).to(state.device) for x in (plane, normals))
            told[index] = Told(at, outward, 1 / (small.width * small.height))


def loss(state: State, step: Step) -> Tensor | None:
    """Compute how far this step's normals are from what outlines tell. Return None if they tell none.

    The loss is a scalar: a mean over the pixels of the whole photo, also if only a crop is rendered. It saturates: e / (e + WRONG) at a
    place where 1 − the cosine is e, times metallic.
    """
    told, rendering, camera = state.part(Outlines).told.get(step.view), step.rendering, step.photo.camera
    weight = state.losses.outlines
    if told is None or rendering.material is None or weight == 0:
        return None
    column = (told.plane[:, 0] * camera.fx + camera.cx).floor().long()
    row = (told.plane[:, 1] * camera.fy + camera.cy).floor().long()
    shown = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    at = row.clamp(0, camera.height - 1) * camera.width + column.clamp(0, camera.width - 1)
    metal = rendering.metallic.detach().flatten()[at]
    counts = shown * (rendering.alpha.detach().flatten()[at] > SOLID) * metal
    error = 1 - cosine_similarity(rendering.normal.flatten(0, 1)[at], told.normals, dim=1)
    return weight * told.part * (counts * error / (error + WRONG)).sum()
