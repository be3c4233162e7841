"""Measure how large the object is in the photos, and limit surfels and the light's texels to what photos of this size show."""

import math
from statistics import median
from typing import NamedTuple

import numpy as np

from refgs.settings import SurfelSettings
from refgs.spread import spread
from refgs.train.photo import crop_of
from refgs.train.state import State

SIZE_VIEWS = 24  # views that are measured, at most
LEAST = 10_000  # surfels that even the smallest object may get
STARTS = 2 / 3  # of the budget: surfels at the start, at most
GROWTH = 2  # times the surfels of the start
RADIUS = 1 / 4  # of the object's span: the radius of a convex mirror that tells how fine the light's texels are
LEAST_TEXELS = 64  # along a side of the light's cubemap: no fewer for a small object


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


def surfel_limits(settings: SurfelSettings, area: float) -> tuple[int, int]:
    """Return how many surfels an object of `area` pixels may have at the start, and later.

    Later, there may be one surfel a pixel until they are GROWTH times `start`, and `density` surfels a pixel of larger objects. There may
    always be LEAST, but never more than `budget`. If that is less than `budget`, the start has at most STARTS times as many. An `area` of 0
    is not known. If `density` is 0, both numbers are as set.
    """
    if settings.density == 0:
        return settings.start, settings.budget
    grown = GROWTH * settings.start
    budget = max(min(max(area, LEAST), grown), settings.density * area) if area else grown
    if budget >= settings.budget:
        return settings.start, settings.budget
    return min(settings.start, round(STARTS * budget)), round(budget)


def light_resolution(finest: int, span: float) -> int:
    """Return how many texels along a side the light's cubemap gets for an object that spans so many pixels, at most `finest`.

    In the middle of a ball whose radius is r pixels, mirror directions of neighbouring pixels are 2 / r radians apart. Elsewhere they are
    farther apart. Photos do not show finer texels, and held-out photos are explained less well with them.
    """
    side = finest
    while side > LEAST_TEXELS and 0 < span * RADIUS * math.pi / 2 <= 2 * (side // 2):
        side //= 2
    return side


def limit_sizes(state: State, size: ObjectSize) -> None:
    """Lower the number of surfels, and of the light's texels, to what photos of an object of this `size` need."""
    settings = state.settings.surfels
    known = f"the object covers {size.area:,.0f} pixels of a photo" if size.area else "no masks show the object's size"
    start, budget = surfel_limits(settings, size.area)
    for key, now, limit in (("start", settings.start, start), ("budget", settings.budget, budget)):
        if limit < now:
            state.change(f"surfels.{key}", limit, "photos", known)
    if (side := texels_of_light(state, size.span)) < state.settings.environment.resolution:
        state.change("environment.resolution", side, "photos", f"the object spans {size.span:,.0f} pixels of a photo")


def texels_of_light(state: State, span: float) -> int:
    """Return how many texels along a side the light's cubemap has unless nothing is mirrored sharply: what the user asked for, or fewer."""
    asked = state.effective.asked.environment.resolution
    return light_resolution(asked, span) if state.settings.surfels.density else asked
