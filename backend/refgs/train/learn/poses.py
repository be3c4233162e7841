"""Refine the cameras' poses during the training, and find out whether they need it.

Each view has a pose (see `render.align`), which moves the scene before its camera sees it. Whenever a view is trained on, its pose takes a
Gauss-Newton step towards the photo, first in reduced pictures, so that a camera that is off by some pixels finds back.

Features that photos have in common tell whether poses need that, and whether it has made them better. The photos' own errors cannot: poses
also move where a mirror's image, which is not at rest on the mirror, is not explained yet.
"""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from refgs.capture import Capture
from refgs.capture.matches import match_neighbours, pixels_apart
from refgs.render.align import REDUCTIONS, pose_step, posed
from refgs.render.rendering import Rendering
from refgs.train.photo import Photo
from refgs.train.state import State

FROM, KNOWN, UNTIL = 0.05, 0.3, 2 / 3  # parts of the training: poses start to learn, are judged, and are frozen
MOST = 0.02  # of a step: radians, and scene radii
SAMPLE = 1000  # surfels whose shift in the photos is measured
EXACT = 0.3  # pixels between features and their epipolar lines: poses with less are exact; four real captures have 0.1
BETTER = 0.5  # of the given poses' distance, below which the refined ones must come


def start(state: State) -> None:
    """Give every view a pose, zero, if the setting `cameras.poses` is "on", or if it is "auto" and features contradict the given poses."""
    wanted = state.settings.cameras.poses
    if wanted == "auto":
        with state.clock.part("start"):
            apart = pixels_apart(match_neighbours(state.views), state.given)
        wanted = "off" if apart is None or apart < EXACT else "on"
        if wanted == "on":
            state.announce("poses", f"the cameras' poses are refined: features are {apart:.1f} pixels off")
    if wanted == "on":
        state.poses = torch.zeros(len(state.views), 6)


@torch.no_grad()
def refine_due(state: State, view: int, rendering: Rendering, photo: Photo, progress: float) -> None:
    """Move the pose of a view towards its photo, if poses learn now. At the end of an epoch, remove the motion that all views share.

    `rendering` is the picture of the `photo` of the view. A step that is not finite is ignored.
    """
    if state.poses is None or not FROM <= progress < UNTIL:
        return
    centre, radius = state.capture.centre, state.capture.radius
    level = int((progress - FROM) / (KNOWN - FROM) * len(REDUCTIONS))
    reduction = REDUCTIONS[min(level, len(REDUCTIONS) - 1)]
    reduction = max(reduction // (state.reduced.factor if state.reduced else 1), 1)  # the photo may be reduced already
    step = pose_step(rendering, photo.over(state.background), photo.camera, centre, radius, reduction)
    if step.isfinite().all():
        state.poses[view] += step.clamp(-MOST, MOST)
        _move(state, view)
    if state.iteration % len(state.views) == len(state.views) - 1:
        state.poses = _without_common(state)
        for index in range(len(state.views)):
            _move(state, index)


def restore(state: State, poses: Tensor | None) -> None:
    """Set the poses of all views, or None: then all cameras are the capture's own."""
    state.poses = poses
    for index in range(len(state.views)):
        _move(state, index)


def put_back_if_worse(state: State, progress: float) -> None:
    """Once, go back to the given poses if the setting `cameras.poses` is "auto" and features do not fit the refined ones far better."""
    if state.poses is None or state.settings.cameras.poses != "auto" or state.poses_judged or progress < KNOWN:
        return
    state.poses_judged = True
    # The pairs that `start` matched: neighbours may be others by now, with too few matches to tell.
    matches = match_neighbours(
        [replace(view, camera=camera) for view, camera in zip(state.views, state.given, strict=True)]
    )
    given, found = (pixels_apart(matches, cameras) for cameras in (state.given, [view.camera for view in state.views]))
    if found < BETTER * given:
        what = f"the cameras' poses are refined: features are {found:.1f} pixels off, and were {given:.1f}"
    else:
        restore(state, None)
        what = f"the cameras' poses are kept: features are {given:.1f} pixels off, and {found:.1f} with refined ones"
    state.announce("poses", what)


@torch.no_grad()
def shifts(state: State) -> np.ndarray:
    """Measure by how many pixels the refined poses move the surfels in each photo: the root mean square over some surfels, (V,)."""
    positions = state.learned["position"].double().numpy(force=True)
    points = positions[:: max(1, len(positions) // SAMPLE)]
    points = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    found = []
    for given, view in zip(state.given, state.views, strict=True):
        before, after = (points @ camera.projection.T for camera in (given, view.camera))
        shown = (before[:, 2] > state.near) & (after[:, 2] > state.near)
        difference = (before[:, :2] / before[:, 2:] - after[:, :2] / after[:, 2:])[shown]
        found.append(np.sqrt(np.square(difference).sum(axis=1).mean()) if shown.any() else 0.0)
    return np.array(found)


def refined(state: State) -> Capture:
    """Return the capture with the refined cameras of the training views."""
    if state.poses is None:
        return state.capture
    poses = {view.camera.name: pose for view, pose in zip(state.views, state.poses, strict=True)}
    centre, radius = state.capture.centre, state.capture.radius
    views = [
        replace(view, camera=posed(view.camera, poses[view.camera.name], centre, radius))
        if view.split == "train" and view.camera.name in poses
        else view
        for view in state.capture.views
    ]
    return replace(state.capture, views=views)


def _move(state: State, index: int) -> None:
    camera = state.given[index]
    if state.poses is not None:
        camera = posed(camera, state.poses[index], state.capture.centre, state.capture.radius)
    state.move_camera(index, camera)


def _without_common(state: State) -> Tensor:
    """Return the poses without what moves the scene as a whole: their mean, and the mean motion towards the cameras, which scales it."""
    towards = np.array([camera.position - state.capture.centre for camera in state.given])
    towards = torch.from_numpy(towards / np.linalg.norm(towards, axis=1, keepdims=True)).float()
    poses = state.poses - state.poses.mean(dim=0)
    poses[:, 3:] -= (poses[:, 3:] * towards).sum(dim=1).mean() * towards
    return poses
