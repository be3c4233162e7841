"""Decide whether a training needs all of its photos, and the photos' pixels beyond the masks."""

import math

import numpy as np

from refgs.capture import LoadedView
from refgs.compare.metrics import psnr
from refgs.train import probe
from refgs.train.decide.need import MEGA, Decision, Given, Moment, Need
from refgs.train.photo import MARGIN, crop_of
from refgs.train.state import State
from refgs.train.timeline import WHOLE_EVERY, Step

ALIKE_PIXELS, ALIKE_DECIBELS = 0.5, 40.0  # duplicates move by less, and differ by 8-bit noise alone


class Views(Need):
    """Decide whether the training needs all of its views. Views that duplicate others are removed."""

    name, what, shown = "views", "duplicate photos", True
    threshold, reason = 1, "each duplicate costs as much as a photo that adds something"
    moments = ("photos",)

    def measure(self, state: State, given: Given) -> Decision | None:
        found = duplicate_views(state.views, state.capture.radius)
        if not found:
            return None
        size = sum(state.views[view].image.nbytes for view in found)
        count = f"{len(found)} of {len(state.views)}"
        why = f"{count} show what another shows, from less than {ALIKE_PIXELS} pixels away"

        def remove() -> None:
            state.views = [view for number, view in enumerate(state.views) if number not in found]

        return Decision(False, why, {"megabytes": size / MEGA}, len(found), once=remove)


class Outside(Need):
    """Decide whether the training needs pixels beyond the masks; if not, photos are cropped."""

    name, what = "outside", "the pixels beyond the masks"
    threshold, reason = 0.1, "a part of the pixels; the time that less saves could not be measured"
    moments = ("start",)

    def due(self, state: State, moment: Moment) -> bool:
        return state.from_hull and state.settings.loss.alpha > 0

    def measure(self, state: State, given: Given) -> Decision | None:
        crops = [crop_of(view, MARGIN) for view in state.views]
        within = sum((rows.stop - rows.start) * (columns.stop - columns.start) for rows, columns in crops)
        part = 1 - within / sum(photo.image[..., 0].numel() for photo in state.photos)
        if self.asked(state) == "auto" and part < self.threshold:
            return None
        beyond = f"{part:.0%} of the photos' pixels lie more than {MARGIN} pixels beyond the masks' bounds"

        def crop() -> None:
            state.crops = crops

        return Decision(False, f"{beyond}; one photo in {WHOLE_EVERY} is whole", statistic=part, once=crop)


def time_crops(state: State, step: Step) -> None:
    """Measure once how many seconds cropping saves, and add them to the recorded decision."""
    if state.crops is not None and state.needs["outside"].seconds is None:
        seconds = (1 - 1 / WHOLE_EVERY) * probe.seconds_saved(state, whole=True)
        state.needs["outside"] = state.needs["outside"].model_copy(update={"seconds": seconds})


def duplicate_views(views: list[LoadedView], radius: float) -> list[int]:
    """Return the indices of views that duplicate an earlier view. `radius` is the object's radius in world units.

    A view is a duplicate if points of the object move by less than ALIKE_PIXELS between the two photos, and the photos look the same.
    """
    found, kept = [], []
    for number, view in enumerate(views):
        alike = any(
            motion(views[other], view, radius) < ALIKE_PIXELS and _agreement(views[other], view) > ALIKE_DECIBELS
            for other in kept
        )
        (found if alike else kept).append(number)
    return found


def motion(one: LoadedView, other: LoadedView, radius: float) -> float:
    """Return an upper bound, in pixels, of how far a point of the object moves from one photo to the other.

    The object is assumed to lie within `radius`, in world units, of the origin. The bound is infinite if the photos differ in
    size, or if only one of them has a mask.
    """
    a, b = one.camera, other.camera
    if (a.width, a.height) != (b.width, b.height) or (one.alpha is None) != (other.alpha is None):
        return math.inf
    distance = float(np.linalg.norm(a.position))
    shift = float(np.linalg.norm(a.position - b.position)) / max(distance - radius, 0.1 * radius)
    turn = float(np.linalg.norm(a.world_to_camera[:3, :3] - b.world_to_camera[:3, :3]))
    lens = abs(a.fx - b.fx) + abs(a.fy - b.fy) + abs(a.cx - b.cx) + abs(a.cy - b.cy)
    return (shift + turn) * max(a.fx, a.fy) + lens


def _agreement(one: LoadedView, other: LoadedView) -> float:
    """Compute the PSNR in dB between two photos of one size, clipped to white."""
    return psnr(*(np.minimum(view.encoded, 1) for view in (one, other)))
