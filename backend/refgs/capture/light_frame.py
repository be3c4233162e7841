"""Find out from the photos, before training, whether the light stands still in the world or turns with the camera."""

import cv2
import numpy as np
import torch

from refgs.camera import Camera
from refgs.capture.images import LoadedView
from refgs.color import srgb_decode
from refgs.geometry.project import inside, project, sample
from refgs.model import harmonics
from refgs.model.environment import turn_between

PHOTO_SIDE = 96  # largest side of a sampled picture, in pixels: the hull does not fit the object in finer detail
POINTS = 2000
FRONTAL = 0.3  # a point is used if the cosine between its normal and the camera's direction is above this
BEHIND = 0.1  # scene radii; a point this far behind the foremost one counts as hidden
DEGREE = 3  # of the spherical harmonics
FLOOR = 0.01  # radiance added to all, so that black has a logarithm
FOLDS = 4
FEWEST = 3  # a point's own brightness is known if at least this many photos show it
PENALTY = 1e-4
PASSES = 4
LESS = 0.95  # the light turns only if its model's error is below this fraction of that of a still light


def light_frame(views: list[LoadedView], positions: np.ndarray, normals: np.ndarray, radius: float) -> tuple[str, str]:
    """Find out from the photos whether the light stands still ("world") or turns with the camera ("camera"), as on a turntable.

    Returns "world" or "camera", and the reason in words. `positions` (N, 3) and `normals` (N, 3) are points on the object's visual hull.
    `radius` is the scene's radius.

    Two models of how bright the points look are compared, one for each kind of light. Both are fitted to three quarters of the photos, and
    must then predict the other photos. A model explains the logarithm of the brightness by a constant for each point, a constant for each
    photo (its exposure), and spherical harmonics of directions. The model of a still light uses the mirror direction in the world. The
    model of a turning light uses the normal and the mirror direction in the camera's frame. "camera" is chosen only if its predictions are
    clearly better. The choice takes seconds and is deterministic.
    """
    points, photos, brightness, still, turning = _observations(views, positions, normals, radius)
    if len(np.unique(photos)) < 2 * FOLDS or len(points) < 100:
        return "world", "there are too few photos to tell"
    alone = np.zeros((len(points), 0))
    around, world, camera = (_prediction_error(brightness, x, points, photos) for x in (alone, still, turning))
    if around < 1e-6:
        return "world", "all photos are alike"
    told = [f"{max(0.0, 1 - error / around):.0%}" for error in (world, camera)]
    why = (
        f"of how the object's brightness changes from photo to photo, a light that stands still explains {told[0]}, one that "
        f"turns with the camera {told[1]}"
    )
    return ("camera" if camera < LESS**2 * world else "world"), why


def _observations(views: list[LoadedView], positions: np.ndarray, normals: np.ndarray, radius: float) -> tuple:
    """Sample the photos at the points that they show. Returns one row for each of the M pairs of a photo and a visible point.

    The results are the points' indices (M,), the photos' indices (M,), the log radiance (M,), and two tables (M, K) of spherical harmonics,
    which model the radiance: the first under a light that stands still, the second under a light that turns with the camera.
    """
    some = np.arange(0, len(positions), max(1, len(positions) // POINTS))
    coarse = int(np.clip(0.75 * np.sqrt(len(positions)), 16, PHOTO_SIDE))  # coarse enough that points leave no holes
    reference, rows = views[0].camera, []
    for number, view in enumerate(views):
        camera = view.camera.fitted(PHOTO_SIDE)
        shown = cv2.resize(view.image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        radiance = np.asarray(srgb_decode(shown.astype(np.float32) / view.white)).mean(axis=-1)
        ahead, behind = _visibility(camera.fitted(coarse), positions, some)
        towards = camera.position - positions[some]
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        cosine = (normals[some] * towards).sum(axis=1)
        seen = np.flatnonzero(ahead & (cosine > FRONTAL) & (behind < BEHIND * radius))
        normal = normals[some][seen]
        mirrored = 2 * cosine[seen, None] * normal - towards[seen]
        turn = turn_between(camera, reference)
        pixels = project(camera, positions[some][seen])[0]
        rows.append(
            (
                seen,
                np.full(len(seen), number),
                np.log(sample(radiance, pixels, clamp=True).astype(np.float64) + FLOOR),
                _harmonics(mirrored),
                np.concatenate([_harmonics(normal @ turn.T), _harmonics(mirrored @ turn.T)], axis=1),
            )
        )
    return tuple(np.concatenate(column) for column in zip(*rows, strict=True))


def _visibility(camera: Camera, positions: np.ndarray, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which `indices` are in the picture, and their depths behind the foremost points."""
    pixels, depth = project(camera, positions)
    ahead = inside(camera, pixels, depth)
    limits = camera.height - 1, camera.width - 1
    row, column = (np.clip(np.nan_to_num(pixels[:, i]), 0, limits[1 - i]).astype(int) for i in (1, 0))
    foremost = np.full((camera.height, camera.width), np.inf, np.float32)
    np.minimum.at(foremost, (row[ahead], column[ahead]), depth[ahead])
    foremost = cv2.erode(foremost, np.ones((3, 3)))
    return ahead[indices], (depth - foremost[row, column])[indices]


def _harmonics(directions: np.ndarray) -> np.ndarray:
    return harmonics.basis(torch.from_numpy(directions.astype(np.float64)), DEGREE)[:, 1:].numpy()


def _prediction_error(values: np.ndarray, terms: np.ndarray, points: np.ndarray, photos: np.ndarray) -> float:
    """Cross-validate over photos a linear model of `values` by `terms`; return the mean squared error."""
    # Each value is a linear function of its terms, plus a constant for its point, plus one for its photo.
    total = count = 0
    for fold in range(FOLDS):
        known = photos % FOLDS != fold
        often = np.bincount(points[known], minlength=points.max() + 1) >= FEWEST
        asked = ~known & often[points]
        columns = np.column_stack([values, terms])
        of_photo = np.zeros((photos.max() + 1, columns.shape[1]))
        of_point = np.zeros((points.max() + 1, columns.shape[1]))
        for _ in range(PASSES):  # average over points and over photos in turn
            of_point = _means(columns[known] - of_photo[photos[known]], points[known], points.max() + 1)
            of_photo = _means(columns[known] - of_point[points[known]], photos[known], photos.max() + 1)
        columns = columns - of_point[points] - of_photo[photos]  # `of_photo` is still zero for the photos to predict
        y, x = columns[:, 0], columns[:, 1:]
        normal = x[known].T @ x[known] + PENALTY * known.sum() * np.eye(x.shape[1])
        error = (y - x @ np.linalg.solve(normal, x[known].T @ y[known]))[asked]
        error -= _means(error[:, None], photos[asked], photos.max() + 1)[photos[asked], 0]
        total, count = total + float(error @ error), count + len(error)
    return total / max(count, 1)


def _means(values: np.ndarray, group: np.ndarray, groups: int) -> np.ndarray:
    """Average the rows of `values` (M, K) in each group; empty groups get zero."""
    sums = np.stack([np.bincount(group, column, groups) for column in values.T], axis=1)
    return sums / np.maximum(np.bincount(group, minlength=groups), 1)[:, None]
