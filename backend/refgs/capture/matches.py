"""Match features between photos, and measure how well the given cameras agree with the matches."""

from typing import NamedTuple

import cv2
import numpy as np

from refgs.camera import Camera
from refgs.capture.colmap_steps import epipolar_distance
from refgs.capture.images import LoadedView
from refgs.spread import spread

SOME = 24  # photos that are matched
SIDE = 800  # pixels of the longer side that they are reduced to; SIFT takes 180 bytes for each of a photo's pixels
FEATURES = 2000  # of a photo
DISTINCT = 0.8  # of the second-best match's distance, below which a match counts (Lowe 2004, §7.1)
TOLERANCE = 1.0  # pixels from the epipolar geometry that fits a pair best; other matches are wrong
AGREEING = 0.5  # part of a pair's distinct matches that fits one epipolar geometry; where less does, that may be chance
LEAST = 16  # matches of a pair of photos; fewer say little about its epipolar geometry, which has 7 degrees of freedom
LEAST_PAIRS = 8


class Matches(NamedTuple):
    """Hold the matched pixels of two photos.

    `first` and `second` are the indices of the two views. `ours` and `theirs` (M, 2) are the pixels of the same M points in the first and
    in the second photo. They are coordinates in photos reduced to SIDE pixels on the longer side.
    """

    first: int
    second: int
    ours: np.ndarray
    theirs: np.ndarray


def match_neighbours(views: list[LoadedView]) -> list[Matches]:
    """Match the features of some photos, evenly spread, each with the photo of the nearest camera. Use only pixels inside the masks.

    For each pair of photos, an epipolar geometry is fitted to the matches, without using the cameras. Matches that do not fit it are
    dropped. If most matches of a pair do not fit, the pair is left out, because the few that fit may do so by chance. A pair with too few
    matches is left out, too. Some matches may be wrong: a reflection moves over the surface when the camera moves.
    """
    if len(views) < 2:
        return []
    positions = np.stack([view.camera.position for view in views])
    pairs = set()
    for first in spread(range(len(views)), SOME):
        distance = np.linalg.norm(positions - positions[first], axis=1)
        distance[first] = np.inf
        second = int(distance.argmin())
        pairs.add((min(first, second), max(first, second)))
    features = {index: _features(views[index]) for index in sorted({index for pair in pairs for index in pair})}
    found = (Matches(first, second, *_match(features[first], features[second])) for first, second in sorted(pairs))
    return [matches for matches in found if len(matches.ours) >= LEAST]


def pixels_apart(matches: list[Matches], cameras: list[Camera]) -> float | None:
    """Return how far matches are from their epipolar lines, in pixels of photos reduced to SIDE.

    The median distance is computed for each pair of photos. The result is the lower quartile of these medians. It is None if there are too
    few pairs (fewer than LEAST_PAIRS). A mean would be too high, because matches of reflections in the object are wrong even for correct
    cameras. `cameras` are those of the matched views, in the same order.
    """
    medians = []
    for pair in matches:
        first, second = cameras[pair.first].fitted(SIDE), cameras[pair.second].fitted(SIDE)
        pose = (second.world_to_camera @ np.linalg.inv(first.world_to_camera))[:3]
        distance = epipolar_distance(_rays(pair.ours, first), _rays(pair.theirs, second), pose)
        medians.append(np.median(distance) * (first.fx + second.fx) / 2)
    return float(np.quantile(medians, 0.25)) if len(medians) >= LEAST_PAIRS else None


def _rays(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Return pixels (M, 2) as points on the image plane at depth 1."""
    return (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]


def _features(view: LoadedView) -> tuple[np.ndarray, np.ndarray | None]:
    """Detect features inside a photo's mask. Returns their pixels (M, 2) and descriptors (M, 128), None if there are none."""
    camera = view.camera.fitted(SIDE)
    size = camera.width, camera.height
    grey = cv2.resize(cv2.cvtColor(view.bytes, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA)
    inside = np.empty(0, np.uint8)  # no mask
    if view.alpha is not None:
        alpha = cv2.resize(view.alpha, size, interpolation=cv2.INTER_AREA)
        inside = cv2.erode((alpha > 127).astype(np.uint8), np.ones((5, 5), np.uint8))
    points, descriptors = cv2.SIFT.create(FEATURES, contrastThreshold=0.01).detectAndCompute(grey, inside)
    # OpenCV counts pixels from the centre of the first one, cameras from its corner.
    return np.array([point.pt for point in points]).reshape(-1, 2) + 0.5, descriptors


def _match(
    ours: tuple[np.ndarray, np.ndarray | None], theirs: tuple[np.ndarray, np.ndarray | None]
) -> tuple[np.ndarray, np.ndarray]:
    """Match two results of `_features`. Returns the matched pixels in the first photo (M, 2) and in the second photo (M, 2).

    A match is kept if it is clearly better than the second-best match, and if it fits the epipolar geometry of most matches.
    """
    nothing = np.zeros((0, 2)), np.zeros((0, 2))
    (first, described), (second, others) = ours, theirs
    if described is None or others is None or min(len(described), len(others)) < LEAST:
        return nothing
    nearest = cv2.BFMatcher().knnMatch(described, others, k=2)
    kept = [best for best, other in nearest if best.distance < DISTINCT * other.distance]
    first, second = first[[m.queryIdx for m in kept]], second[[m.trainIdx for m in kept]]
    if len(kept) < LEAST:
        return nothing
    cv2.setRNGSeed(0)
    _, fits = cv2.findFundamentalMat(first, second, cv2.FM_RANSAC, TOLERANCE, 0.999, 10_000)
    if fits is None or fits.mean() < AGREEING:
        return nothing
    fits = fits[:, 0].astype(bool)
    return first[fits], second[fits]
