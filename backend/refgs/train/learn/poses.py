"""Refine the cameras' poses during the training, and find out whether the poses need refinement.

Each view has a pose (see `render.align`), which moves the scene in front of its camera. Whenever a view is trained on, its pose takes a
Gauss-Newton step towards the photo. The first steps use reduced pictures, so that a camera that is off by some pixels still converges.

Features matched between photos show whether poses need refinement, and whether refined poses are better. The error against the photos does
not show this: it also falls if poses move to fit reflections, which the scene does not explain yet.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from refgs.capture import Capture
from refgs.capture.matches import match_neighbours, pixels_apart
from refgs.render.align import REDUCTIONS, pose_step, posed
from refgs.train.learn import coarse
from refgs.train.part import Part
from refgs.train.state import State
from refgs.train.timeline import POSES_FROM, POSES_KNOWN, Step

LONGEST_STEP = 0.02  # largest step, in radians and in scene radii
SAMPLE = 1000  # surfels whose shift in the photos is measured
EXACT = 0.3  # pixels between features and epipolar lines; poses with less are exact; real captures have 0.1
MATCHING = 0.6  # time for matching features, in times of reading the photos and placing the first surfels
BETTER = 0.5  # refined poses must come below this fraction of the given poses' distance


class Poses(Part):
    """Remember the poses of the V training views.

    `given` are the views' cameras in the capture. `values` (V, 6) are the poses, as in `render.align`; None: the given cameras are used.
    `judged` tells whether `judge` has already compared the given and the refined cameras.
    """

    name, saved = "poses", ("judged", "values")
    values: Tensor | None = None
    judged = False

    def start(self, state: State) -> None:
        """Give every view a zero pose, if poses are to be refined.

        Poses are refined if the setting `cameras.poses` is "on", or if it is "auto" and matched features contradict the given cameras.
        """
        self.given, wanted = [view.camera for view in state.views], state.settings.cameras.poses
        known = state.clock.seconds
        seconds = MATCHING * (known["reading"] + known["start"])
        if wanted == "auto" and not state.plan.pays_at_start("a look at whether poses need refinement", seconds):
            wanted = "off"
        if wanted == "auto":
            with state.clock.part("start"):
                apart = pixels_apart(match_neighbours(state.views), self.given)
            wanted = "off" if apart is None or apart < EXACT else "on"
            if wanted == "on":
                state.announce("poses", f"the cameras' poses are refined: features are {apart:.1f} pixels off")
        if wanted == "on":
            self.values = torch.zeros(len(state.views), 6)

    def restore(self, state: State, facts: Mapping[str, Any]) -> None:
        self.judged = facts["judged"]
        self.put(state, facts["values"].cpu() if "values" in facts else None)

    def put(self, state: State, values: Tensor | None) -> None:
        """Set the poses of all views. With None, all cameras are the given ones."""
        self.values = values
        for view in range(len(state.views)):
            self.move(state, view)

    def move(self, state: State, view: int) -> None:
        """Set a view's camera to the given one, moved by the view's pose."""
        camera = self.given[view]
        if self.values is not None:
            camera = posed(camera, self.values[view], state.capture.centre, state.capture.radius)
        state.views[view] = replace(state.views[view], camera=camera)
        state.photos[view] = state.photos[view]._replace(camera=camera)
        coarse.move_camera(state, view, camera)


@torch.no_grad()
def refine(state: State, step: Step) -> None:
    """Refine the pose of this iteration's view by one Gauss-Newton step, if it is finite."""
    poses, photo = state.part(Poses), step.photo
    if poses.values is None:
        return
    centre, radius = state.capture.centre, state.capture.radius
    level = int((step.progress - POSES_FROM) / (POSES_KNOWN - POSES_FROM) * len(REDUCTIONS))
    reduction = REDUCTIONS[min(level, len(REDUCTIONS) - 1)]
    reduction = max(reduction // state.part(coarse.Coarse).factor, 1)  # the photo may be reduced already
    found = pose_step(step.rendering, photo.over(state.background), photo.camera, centre, radius, reduction)
    if found.isfinite().all():
        poses.values[step.view] += found.clamp(-LONGEST_STEP, LONGEST_STEP)
        poses.move(state, step.view)


@torch.no_grad()
def remove_common(state: State, step: Step) -> None:
    """Subtract from all poses their common motion, which would only move or scale the scene."""
    poses = state.part(Poses)
    if poses.values is not None:
        poses.put(state, _without_common(state, poses.values))


def judge(state: State, step: Step) -> None:
    """Compare the refined cameras with the given ones, once, if the setting `cameras.poses` is "auto".

    The refined cameras are kept only if features that are matched between photos fit them far better.
    """
    poses = state.part(Poses)
    if poses.values is None or state.settings.cameras.poses != "auto" or poses.judged:
        return
    poses.judged = True
    # Match the pairs that `start` matched. Refined cameras may have other neighbours, with too few matches to tell.
    given = [replace(view, camera=camera) for view, camera in zip(state.views, poses.given, strict=True)]
    matches = match_neighbours(given)
    given, found = (pixels_apart(matches, cameras) for cameras in (poses.given, [view.camera for view in state.views]))
    if found is not None and given is not None and found < BETTER * given:
        what = f"the cameras' poses are refined: features are {found:.1f} pixels off, and were {given:.1f}"
    else:
        poses.put(state, None)
        what = f"the cameras' poses are kept: features are {given:.1f} pixels off, and {found:.1f} with refined ones"
    state.announce("poses", what)


@torch.no_grad()
def shifts(state: State) -> np.ndarray:
    """Measure by how many pixels (RMS) the refined poses move surfels in each photo (V,)."""
    positions = state.learned["position"].double().numpy(force=True)
    points = positions[:: max(1, len(positions) // SAMPLE)]
    points = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    found = []
    for given, view in zip(state.part(Poses).given, state.views, strict=True):
        before, after = (points @ camera.projection.T for camera in (given, view.camera))
        shown = (before[:, 2] > state.near) & (after[:, 2] > state.near)
        difference = (before[:, :2] / before[:, 2:] - after[:, :2] / after[:, 2:])[shown]
        found.append(np.sqrt(np.square(difference).sum(axis=1).mean()) if shown.any() else 0.0)
    return np.array(found)


def refined(state: State) -> Capture:
    """Return the capture with the refined cameras of the training views."""
    values = state.part(Poses).values
    if values is None:
        return state.capture
    poses = {view.camera.name: pose for view, pose in zip(state.views, values, strict=True)}
    centre, radius = state.capture.centre, state.capture.radius
    views = [
        replace(view, camera=posed(view.camera, poses[view.camera.name], centre, radius))
        if view.split == "train" and view.camera.name in poses
        else view
        for view in state.capture.views
    ]
    return replace(state.capture, views=views)


def _without_common(state: State, values: Tensor) -> Tensor:
    """Return the poses without their mean and their mean motion towards the cameras."""
    towards = np.array([camera.position - state.capture.centre for camera in state.part(Poses).given])
    towards = torch.from_numpy(towards / np.linalg.norm(towards, axis=1, keepdims=True)).float()
    poses = values - values.mean(dim=0)
    poses[:, 3:] -= (poses[:, 3:] * towards).sum(dim=1).mean() * towards
    return poses
