"""Choose the points at which surfels start: on the visual hull of the masks, at structure-from-motion points, or at random."""

from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs

from refgs.capture.box import Box
from refgs.capture.images import LoadedView
from refgs.capture.types import Capture
from refgs.errors import InputError
from refgs.formats.mesh import SmoothMesh
from refgs.geometry.hollows import carve_hollows
from refgs.geometry.hull import Carve, HullPoints, visual_hull_points
from refgs.geometry.shape import Photo
from refgs.settings import SurfelSettings

AROUND = 0.5  # largest fraction of the points that may lie outside the region


class FirstPoints(NamedTuple):
    """Hold the points at which surfels start, in the run's frame (the world coordinates of training).

    `positions` (N, 3); unit `normals` (N, 3); `spacing` (N,), the mean distance to the three nearest points; sRGB `colours` (N, 3) in 0..1,
    or None if unknown. The first `on_hull` points lie on the visual hull, whose mesh is `hull`; both are None if there is no hull. `source`
    says in words where the points come from.
    """

    positions: np.ndarray
    normals: np.ndarray
    spacing: np.ndarray
    colours: np.ndarray | None
    on_hull: int | None
    hull: SmoothMesh | None
    source: str


def first_points(
    capture: Capture, views: list[LoadedView], surfels: SurfelSettings, seed: int, hollows: bool = False
) -> FirstPoints:
    """Choose the points at which surfels start.

    If all photos have masks, most points lie on the visual hull of the masks. These points come first. The other points lie inside the
    hull, because the object may have hollows, which masks do not show. With `hollows`, the hull is first carved where this explains photos
    better (see `hollows.carve_hollows`). This carving needs a light that does not move. If any photo has no mask, the points are those of
    structure from motion, or random. There are at most `surfels.start` and at most `surfels.budget` points.
    """
    count = min(surfels.start, surfels.budget)
    if all(view.alpha is not None for view in views):
        points, on_hull = _hull_points(capture, views, surfels, count, seed, hollows)
        source = "the visual hull of the masks" + (", less what photos see through" if hollows else "")
        return FirstPoints(points.positions, points.normals, points.spacing, None, on_hull, points.surface, source)
    colours = None
    if capture.points is not None and _enough(capture.points, capture.box):
        positions, colours = _thinned(capture.points, capture, count, seed)
        source = f"{len(positions)} structure-from-motion points"
    else:
        positions = _random_points(capture, count, seed)
        source = "random points (no masks and no structure-from-motion points)"
    return FirstPoints(positions, _towards_cameras(positions, views), _spacing(positions), colours, None, None, source)


def _hull_points(
    capture: Capture, views: list[LoadedView], surfels: SurfelSettings, count: int, seed: int, hollows: bool
) -> tuple[HullPoints, int]:
    """Place `count` points: most on the visual hull of the masks, the others inside it.

    Returns the points, and how many of them are on the hull: these come first.
    """
    cameras = [view.camera for view in views]
    photos = [Photo(view.image, view.alpha, view.camera, view.white) for view in views if view.alpha is not None]
    alphas = [photo.alpha for photo in photos]  # all views have one
    carve = partial(carve_hollows, photos=photos, seed=seed) if hollows else None

    shown = max(1, count - round(surfels.inside * count))

    def within(radius: float, carve: Carve | None) -> HullPoints:
        grid = {"resolution": surfels.hull, "seed": seed, "on_hull": shown, "carve": carve}
        return visual_hull_points(alphas, cameras, capture.centre, radius, count, **grid)

    if capture.box is None:
        return within(capture.radius, carve), shown
    around = within(capture.reach, None)  # few points are used: not worth the seconds
    try:
        near = within(capture.radius, carve)
    except InputError:  # masks show an object, but only outside the box
        raise InputError("nothing that the masks show lies in the region: move its box, or enlarge it") from None
    chosen = _in_and_around(capture.box, near.positions, around.positions, count, seed)
    on_it = np.concatenate(chosen) < shown
    order = np.argsort(~on_it, kind="stable")
    positions, normals = (
        np.concatenate([values[rows] for values, rows in zip(pair, chosen, strict=True)])[order]
        for pair in ((near.positions, around.positions), (near.normals, around.normals))
    )
    return HullPoints(positions, normals, _spacing(positions), near.surface), int(on_it.sum())


def _in_and_around(
    box: Box, near: np.ndarray, around: np.ndarray, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Choose indices of `near` inside the box and `around` outside, or raise InputError."""
    rng = np.random.default_rng(seed)
    inner, outer = np.flatnonzero(box.contains(near)), np.flatnonzero(~box.contains(around))
    if len(inner) == 0:
        raise InputError("nothing that the photos show lies in the region: move its box, or enlarge it")
    outer = rng.permutation(outer)[: int(AROUND * count)]
    return np.sort(rng.permutation(inner)[: count - len(outer)]), np.sort(outer)


def _enough(points: np.ndarray, box: Box | None) -> bool:
    """Tell whether at least 100 points are in the box, or anywhere without one."""
    return len(points if box is None else points[box.contains(points)]) >= 100


def _thinned(points: np.ndarray, capture: Capture, count: int, seed: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Choose at most `count` points (N, 3) at random, with their sRGB colours or None."""
    colours, chosen = capture.point_colors, slice(None)
    if capture.box is not None:
        chosen = np.concatenate(_in_and_around(capture.box, points, points, count, seed))
    elif len(points) > count:
        chosen = np.random.default_rng(seed).choice(len(points), count, replace=False)
    return points[chosen], None if colours is None else colours[chosen]


def _random_points(capture: Capture, count: int, seed: int) -> np.ndarray:
    """Place random points in the box or ball, with some around it where needed."""
    # Around a box, and where `capture.bounded` is false, up to half of the points are farther out: their inverse distances are uniform.
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    distance = np.cbrt(rng.random(count))
    if capture.box is not None or not capture.bounded:
        beyond = distance[:: 2 if capture.box is None else 1]
        beyond[:] = 1 / rng.uniform(0.1, 1, len(beyond))
    points = capture.centre + capture.radius * distance[:, None] * direction
    if capture.box is None:
        return points
    matrix = capture.box.matrix
    near = rng.uniform(-1, 1, (count, 3)) @ matrix[:3, :3].T + matrix[:3, 3]
    inner, outer = _in_and_around(capture.box, near, points, count, seed)
    return np.concatenate([near[inner], points[outer]])


def _towards_cameras(positions: np.ndarray, views: list[LoadedView]) -> np.ndarray:
    """Return unit vectors (N, 3) from the points to their nearest cameras, used as normals."""
    cameras = np.stack([view.camera.position for view in views])
    towards = cameras[cKDTree(cameras).query(positions)[1]] - positions
    return towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)


def _spacing(positions: np.ndarray) -> np.ndarray:
    """Compute each point's mean distance (N,) to its three nearest neighbours."""
    k = min(4, len(positions))
    distance = cKDTree(positions).query(positions, k=k)[0][:, 1:] if k > 1 else np.ones((len(positions), 1))
    return np.maximum(distance.mean(axis=1), 1e-7)
