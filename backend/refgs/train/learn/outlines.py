"""Draw normals of metals to what outlines tell.

Photos of a mirror in a dark room hardly tell its normals, and the light gives way to wrong ones. Outlines tell them to a degree or two
wherever they show the surface (see `geometry.outlines`). Paint is not drawn: its own texture tells more than a hull, which has domes over
flat tops. A hull also bridges shallow relief, so the loss saturates where photos contradict.
"""

from torch import Tensor

from refgs.formats.mesh import SmoothMesh
from refgs.geometry import outlines
from refgs.geometry.visibility import Occluder
from refgs.train.learn.told_normals import ToldNormals
from refgs.train.part import Part
from refgs.train.state import State
from refgs.train.timeline import Step


class Outlines(Part):
    """Hold what outlines tell, by the view's index."""

    name = "outlines"

    def start(self, state: State) -> None:
        self.told: dict[int, ToldNormals] = {}


def load(state: State, hull: SmoothMesh | None) -> None:
    """Find the normals of the visual hull in all training views, where outlines tell them."""
    if hull is None or not state.method.lit or state.settings.loss.outlines == 0:
        return
    with state.clock.part("start"):
        cameras = [view.camera for view in state.views]
        known = outlines.told(hull, [view.alpha for view in state.views if view.alpha is not None], cameras)
        surface, told = Occluder(hull), state.part(Outlines).told
        for index, camera in enumerate(cameras):
            told[index] = ToldNormals.of(hull, surface, known, camera, state.device)


def loss(state: State, step: Step) -> Tensor | None:
    """Compute how far this step's normals of metals are from what outlines tell, a scalar. Return None if they tell none."""
    told, weight = state.part(Outlines).told.get(step.view), state.losses.outlines
    if told is None or weight == 0:
        return None
    return told.loss(step, weight, lambda metallic, _: metallic)
