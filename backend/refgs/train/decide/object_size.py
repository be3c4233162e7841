"""Measure how large the object is in the photos, and limit the number of surfels to what this size needs."""

from statistics import median
from typing import NamedTuple

import numpy as np

from refgs.settings import SurfelSettings
from refgs.spread import spread
from refgs.train.photo import crop_of
from refgs.train.state import State

SIZE_VIEWS = 24  # views that are measured, at most
LEAST_GROWTH = 2  # even the smallest object may get this many times the surfels of the start


class ObjectSize(NamedTuple):
    """Hold the object's size in pixels of the photos as loaded: medians over views. Both values are 0 if a photo has no mask.

    `span` is the longer side of the mask's bounds, and `area` is the number of pixels in the mask. If the user set a region to train, the
    photo shows the ball around it as a circle. Then `span` is at most the circle's diameter, and `area` at most the circle's area.
    """

    span: float
    area: float


def object_size(state: State) -> ObjectSize:
    """Measure the object's size in the training photos."""
    if not state.from_hull:
        return ObjectSize(0.0, 0.0)
    spans, areas, capture = [], [], state.capture
    for view in spread(state.views, SIZE_VIEWS):
        rows, columns = crop_of(view, 0)
        span = max(rows.stop - rows.start, columns.stop - columns.start)
        area = view.image[..., 0].size if view.alpha is None else np.count_nonzero(view.alpha > 127)
        if capture.box is not None:
            depth = view.camera.world_to_camera[2] @ [*capture.centre, 1.0]
            ball = 2 * capture.radius * view.camera.fx / max(depth, capture.radius)
            span, area = min(span, ball), min(area, np.pi / 4 * ball**2)
        spans.append(float(span))
        areas.append(float(area))
    return ObjectSize(median(spans), median(areas))


def surfel_budget(settings: SurfelSettings, area: float) -> int:
    """Return how many surfels an object of `area` pixels may get: `density` surfels a pixel.

    The number is at least LEAST_GROWTH · `start`, but never above `budget`. If `density` is 0, the number is `budget`.
    """
    if settings.density == 0:
        return settings.budget
    return min(settings.budget, max(LEAST_GROWTH * settings.start, round(settings.density * area)))


def limit_surfels(state: State, area: float) -> None:
    """Lower the surfel budget to what an object of `area` pixels in a photo needs."""
    if (budget := surfel_budget(state.settings.surfels, area)) < state.settings.surfels.budget:
        known = f"the object covers {area:,.0f} pixels of a photo" if area else "no masks show the object's size"
        state.change("surfels.budget", budget, "photos", known)
