"""Choose the light's frame before training: the world's or the camera's.

The photos tell whether the light stood still or turned with the camera.
"""

import cv2
import numpy as np
import torch

from refgs.camera import Camera
from refgs.capture import LoadedView
from refgs.color import srgb_decode
from refgs.geometry.project import inside, project, sample
from refgs.model import harmonics
from refgs.model.environment import turn_between

SIDE = 96  # pixels: the hull is not the object in finer detail
POINTS = 2000
FACING = 0.3  # cosine to the camera above which a point is used
BEHIND = 0.1  # scene radii behind the foremost point at which a point is hidden
DEGREE = 3  # of the harmonics
DARK = 0.01  # radiance that is added, so that black has a logarithm
FOLDS = 4
FEWEST = 3  # photos of a point that tell its own brightness
RIDGE = 1e-4
SWEEPS = 4
LESS = 0.95  # of the error under a still light: the light turns only where it explains clearly more


def light_frame(views: list[LoadedView], positions: np.ndarray, normals: np.ndarray, radius: float) -> tuple[str, str]:
    """Choose "world" or "camera" from the photos. Returns the choice and the reason.

    `positions` (N, 3) are points on the object's visual hull, with their `normals`. A point's brightness is a number of its own, times a
    factor of the light. Under a still light, this factor changes from photo to photo with the mirror direction alone. Under a light that
    turns with the camera, the factor changes with the normal and the mirror direction, both in the camera's frame.

    The logarithm of the brightness is fitted in three quarters of the photos by harmonics of those directions, a number for each point,
    and a number for each photo, its exposure. The frame whose fit better predicts the other photos, up to their exposures, is chosen.
    "camera" is chosen only if it predicts them clearly better. The choice takes seconds and is deterministic.
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
    """List the brightness of points in the photos, a row for each of the M times that a photo shows a point.

    Returns the indices of the points and of the photos (M,), the log radiance (M,), and the harmonics (M, K) that explain it under a still
    light and under a turning light.
    """
    some = np.arange(0, len(positions), max(1, len(positions) // POINTS))
    coarse = int(np.clip(0.75 * np.sqrt(len(positions)), 16, SIDE))  # coarse enough that points leave no holes
    reference, rows = views[0].camera, []
    for number, view in enumerate(views):
        camera = view.camera.fitted(SIDE)
        shown = cv2.resize(view.image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        radiance = srgb_decode(shown.astype(np.float32) / 255).mean(axis=-1)
        ahead, behind = _in_front(camera.fitted(coarse), positions, some)
        towards = camera.position - positions[some]
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        cosine = (normals[some] * towards).sum(axis=1)
        seen = np.flatnonzero(ahead & (cosine > FACING) & (behind < BEHIND * radius))
        normal = normals[some][seen]
        mirrored = 2 * cosine[seen, None] * normal - towards[seen]
        turn = turn_between(camera, reference)
        pixels = project(camera, positions[some][seen])[0]
        rows.append(
            (
                seen,
                np.full(len(seen), number),
                np.log(sample(radiance, pixels, clamp=True).astype(np.float64) + DARK),
                _harmonics(mirrored),
                np.concatenate([_harmonics(normal @ turn.T), _harmonics(mirrored @ turn.T)], axis=1),
            )
        )
    return tuple(np.concatenate(column) for column in zip(*rows, strict=True))


def _in_front(camera: Camera, positions: np.ndarray, some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tell which of the points with indices `some` are inside the picture.

    Return also how far each of these points lies behind the foremost of all points at its pixel, in world units.
    """
    pixels, depth = project(camera, positions)
    ahead = inside(camera, pixels, depth)
    limits = camera.height - 1, camera.width - 1
    row, column = (np.clip(np.nan_to_num(pixels[:, i]), 0, limits[1 - i]).astype(int) for i in (1, 0))
    foremost = np.full((camera.height, camera.width), np.inf, np.float32)
    np.minimum.at(foremost, (row[ahead], column[ahead]), depth[ahead])
    foremost = cv2.erode(foremost, np.ones((3, 3)))
    return ahead[some], (depth - foremost[row, column])[some]


def _harmonics(directions: np.ndarray) -> np.ndarray:
    return harmonics.basis(torch.from_numpy(directions.astype(np.float64)), DEGREE)[:, 1:].numpy()


def _prediction_error(values: np.ndarray, terms: np.ndarray, points: np.ndarray, photos: np.ndarray) -> float:
    """Return the mean squared error of a fit on photos that the fit has not seen (cross-validation).

    The fit explains each of the `values` (M,) as a sum: a linear function of `terms` (M, K), a number for its point, and a number for its
    photo. `points` and `photos` (M,) are the indices of these.
    """
    total = count = 0
    for fold in range(FOLDS):
        known = photos % FOLDS != fold
        often = np.bincount(points[known], minlength=points.max() + 1) >= FEWEST
        asked = ~known & often[points]
        columns = np.column_stack([values, terms])
        of_photo = np.zeros((photos.max() + 1, columns.shape[1]))
        for _ in range(SWEEPS):  # means of points and of photos, one after the other
            of_point = _means(columns[known] - of_photo[photos[known]], points[known], points.max() + 1)
            of_photo = _means(columns[known] - of_point[points[known]], photos[known], photos.max() + 1)
        columns = columns - of_point[points] - of_photo[photos]  # zero so far for the photos to predict
        y, x = columns[:, 0], columns[:, 1:]
        normal = x[known].T @ x[known] + RIDGE * known.sum() * np.eye(x.shape[1])
        error = (y - x @ np.linalg.solve(normal, x[known].T @ y[known]))[asked]
        error -= _means(error[:, None], photos[asked], photos.max() + 1)[photos[asked], 0]
        total, count = total + float(error @ error), count + len(error)
    return total / max(count, 1)


def _means(values: np.ndarray, group: np.ndarray, groups: int) -> np.ndarray:
    """Average the rows of `values` (M, K) in each group: `group` (M,) is each row's group. Returns (groups, K), zero for empty groups."""
    sums = np.stack([np.bincount(group, column, groups) for column in values.T], axis=1)
    return sums / np.maximum(np.bincount(group, minlength=groups), 1)[:, None]
