"""Find an object's silhouettes in photos with known cameras: what has the object's colours, and agrees with a carved shape.

Photos are segmented together (after Campbell et al. 2010, "Automatic 3D object segmentation in multiple views").
A grid of voxels holds the probability that the object is there. In turns, colour histograms of object and surroundings are learned from the
voxels' projection, and voxels are kept where nearly all photos show the object's colours. GrabCut (OpenCV) then finds the exact edges.
What is seen through a hole looks like the surroundings from neighbouring places, too. A highlight does not: it wanders over the surface.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter, label

from refgs.camera import Camera
from refgs.capture.box import Box
from refgs.geometry.project import inside, project

GRID = 48  # voxels along an edge of the box
ROUNDS = 6  # of colours and carving; a real head's shape changes by less than 1 % in the last one
DISAGREE = 0.12  # part of the photos that may contradict a voxel: colours are ambiguous in some
OPEN = 0.2  # probability below which two neighbouring photos see through a voxel, as through a ring, whatever the others say
NEAR = 0.2  # probability from which a pixel may be object, so that thin parts, which few voxels hold, are not lost
SEEN = 0.3  # part of the photos that must show a voxel
COUNTED = 0.1  # part of the largest object's volume, from which on another one is an object too
LEVELS = (20, 32, 32)  # bins of the histograms, in Lab


@dataclass(frozen=True, eq=False)
class Photo:
    """Reduced photo: `image` (H, W, 3) uint8 RGB, its pinhole `camera`, and what is `known` (H, W) int8: 1 object, −1 not, 0 nothing."""

    image: np.ndarray
    camera: Camera
    known: np.ndarray

    @cached_property
    def bins(self) -> np.ndarray:
        """Return the histogram bin of each pixel, (H, W)."""
        lab = cv2.cvtColor(self.image, cv2.COLOR_RGB2LAB).astype(int)
        a, b = (np.clip((lab[..., i] - 128) // 5 + 16, 0, 31) for i in (1, 2))
        return (lab[..., 0] * LEVELS[0] // 256 * LEVELS[1] + a) * LEVELS[2] + b


@dataclass(frozen=True, eq=False)
class Shape:
    """Carved shape: `occupied` (GRID³,) in 0..1 at the points of `box.grid(GRID)`, the number of separate `objects`, and the colours."""

    box: Box
    occupied: np.ndarray
    objects: int
    colors: tuple[np.ndarray, np.ndarray]

    def bounds(self, to_frame: np.ndarray) -> Box:
        """Return the box, parallel to the axes, about the shape in other coordinates, with a margin of a twentieth.

        `to_frame` (4, 4) is p_new = to_frame @ p.
        """
        points = self.box.grid(GRID)[self.occupied > 0.5] @ to_frame[:3, :3].T + to_frame[:3, 3]
        low, high = points.min(axis=0), points.max(axis=0)
        matrix = np.diag([*((high - low) / 2 * 1.1 + 1e-9), 1.0])
        matrix[:3, 3] = (low + high) / 2
        return Box(matrix)

    def project(self, camera: Camera) -> np.ndarray:
        """Return the largest probability along each pixel's ray, (H, W) float32."""
        return _project_voxels(self.occupied, self.box, camera)


def carve_object(
    photos: list[Photo], box: Box, fill: float, floor: tuple[np.ndarray, float] | None, progress
) -> Shape | None:
    """Carve the object in a box out of the photos. Return None if nothing is left.

    At first the object is taken for an ellipsoid in the box, which fills the part `fill` of it. `floor` is the plane (normal, distance)
    that it stands on, or None. `progress(done, total)` is called after each round.
    """
    points = box.grid(GRID)
    centred = np.linalg.norm(np.linalg.solve(box.matrix[:3, :3], (points - box.centre).T), axis=0)
    occupied = np.clip(1.3 - 1.25 * centred / fill, 0.0, 0.85)
    allowed = np.ones(len(points), bool) if floor is None else points @ floor[0] > floor[1]
    occupied[~allowed] = 0
    pixels = [_pixels(points, photo.camera) for photo in photos]
    seen = sum((at >= 0).astype(int) for at in pixels)
    allowed &= seen >= max(2, SEEN * len(photos))
    pairs = _neighbours(photos, box.centre)
    objects, colors = 0, None
    for turn in range(ROUNDS):
        priors = [_project_voxels(occupied, box, photo.camera, at) for photo, at in zip(photos, pixels, strict=True)]
        colors = _learn_colors(photos, priors, colors)
        votes = np.full((len(photos), len(points)), 255, np.uint8)  # bytes sort fast
        struck = np.zeros(len(points), bool)
        for vote, photo, prior, at in zip(votes, photos, priors, pixels, strict=True):
            shown = at >= 0
            vote[shown] = (255 * _posterior(photo, prior, colors)).astype(np.uint8).ravel()[at[shown]]
            struck[shown] |= (photo.known.ravel()[at[shown]] < 0) & (vote[shown] < 128)
        for pair in pairs:
            struck |= votes[pair].max(axis=0) < 255 * OPEN
        ordered = np.sort(np.ascontiguousarray(votes.T), axis=1)
        kept = ordered[np.arange(len(points)), (DISAGREE * seen).astype(int)] / np.float32(255)
        kept[~allowed | struck] = 0
        field = gaussian_filter(kept.reshape(GRID, GRID, GRID), 0.7)
        parts, count = label(field > 0.5)
        if count == 0:
            return None
        sizes = np.bincount(parts.ravel())
        sizes[0] = 0
        large = sizes >= COUNTED * sizes.max()
        objects = int(large.sum())
        occupied = np.where(large[parts] | (parts == 0), field, 0).ravel()
        progress(turn + 1, ROUNDS)
    return Shape(box, occupied, objects, colors)


def cut_out(photo: Photo, shape: Shape) -> np.ndarray:
    """Find the silhouette's exact edge in a photo. Return the mask (H, W) uint8, 0 or 255."""
    prior = shape.project(photo.camera)
    likely = _posterior(photo, prior, shape.colors) > 0.5
    margin = max(3, round(0.03 * max(prior.shape))) | 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (margin, margin))
    solid = (prior > 0.5).astype(np.uint8)
    core = cv2.erode(solid, kernel, borderValue=1) > 0
    around = cv2.dilate(((prior > NEAR) | (photo.known > 0)).astype(np.uint8), kernel) > 0
    labels = np.where(likely, np.uint8(cv2.GC_PR_FGD), np.uint8(cv2.GC_PR_BGD))
    labels[core & likely] = cv2.GC_FGD
    labels[~around] = cv2.GC_BGD
    labels[photo.known > 0] = cv2.GC_FGD
    labels[photo.known < 0] = cv2.GC_BGD
    rows, columns = (np.flatnonzero(around.any(axis=axis)) for axis in (1, 0))
    if len(rows):
        # GrabCut takes seconds for a large picture: it gets the shape and a margin about it.
        part = tuple(
            slice(max(0, at[0] - 2 * margin), min(size, at[-1] + 1 + 2 * margin))
            for at, size in zip((rows, columns), prior.shape, strict=True)
        )
        inner = labels[part].copy()
        if ((inner & 1) > 0).any() and ((inner & 1) == 0).any():
            image = np.ascontiguousarray(photo.image[part][..., ::-1])
            cv2.grabCut(image, inner, None, np.zeros((1, 65)), np.zeros((1, 65)), 2, cv2.GC_INIT_WITH_MASK)
            labels[part] = inner
    mask = _only_connected(labels & 1, solid > 0, photo.known)
    return np.where(mask, np.uint8(255), np.uint8(0))


def _only_connected(mask: np.ndarray, solid: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Drop the parts of a mask that do not touch the shape's projection `solid`, and close the holes that the shape does not have.

    Such holes are highlights. What strokes say (`known`) stays.
    """
    _, parts = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    kept = np.isin(parts, np.unique(parts[(mask > 0) & (solid | (known > 0))])) & (mask > 0)
    _, holes = cv2.connectedComponents((~kept).astype(np.uint8), connectivity=4)
    edge = np.concatenate([holes[0], holes[-1], holes[:, 0], holes[:, -1]])
    opened = np.isin(holes, np.unique([*edge, *holes[~kept & (~solid | (known < 0))]]))
    return kept | ~opened


def find_floor(
    points: np.ndarray, centre: np.ndarray, radius: float, up: np.ndarray
) -> tuple[np.ndarray, float] | None:
    """Find the plane that the object stands on: most structure-from-motion points, hardly any below, and within 30° of level.

    Return its normal and a distance just above it: points p on the object's side have normal @ p > distance. Return None if no plane
    with a twentieth of the points is found. `centre` and `radius` are a ball about the object; `up` is the world's up direction.
    """
    near = points[np.linalg.norm(points - centre, axis=1) < 3 * radius]
    if len(near) < 50:
        return None
    random = np.random.default_rng(0)
    best, found = 0.05 * len(near), None
    for _ in range(1000):
        a, b, c = near[random.choice(len(near), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-9 * radius**2:
            continue
        normal *= np.sign(normal @ up) / length
        height = near @ normal - a @ normal
        # What it carries is not part of it: its points reach beyond the object.
        on = np.abs(height) < 0.015 * radius
        if (
            normal @ up < 0.87
            or (height < -0.04 * radius).mean() > 0.03
            or on.sum() <= best
            or normal @ (centre - a) < 0.1 * radius
        ):
            continue
        if np.linalg.norm(near[on] - near[on].mean(axis=0), axis=1).mean() > 0.8 * radius:
            best, found = on.sum(), (normal, float(a @ normal) + 0.03 * radius)
    return found


def _neighbours(photos: list[Photo], centre: np.ndarray) -> np.ndarray:
    """Return the pairs (N, 2) of each photo and the nearest one that looks at `centre` from another direction: by 5° to 40°."""
    away = np.array([photo.camera.position for photo in photos]) - centre
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(away @ away.T, -1, 1)))
    angle[(angle < 5) | (angle > 40)] = np.inf
    pairs = np.column_stack([np.arange(len(photos)), angle.argmin(axis=1)])[np.isfinite(angle.min(axis=1))]
    return np.unique(np.sort(pairs, axis=1), axis=0)


def _pixels(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the index of the pixel that shows each point (N,), −1 if the photo does not show it."""
    at, depth = project(camera, points)
    shown = inside(camera, at, depth)
    column, row = np.where(shown[:, None], at, 0).astype(np.int32).T
    index = np.minimum(row, camera.height - 1) * camera.width + np.minimum(column, camera.width - 1)
    return np.where(shown, index, -1)


def _project_voxels(occupied: np.ndarray, box: Box, camera: Camera, at: np.ndarray | None = None) -> np.ndarray:
    """Return the largest value of the voxels along each pixel's ray, (H, W) float32, smooth over a voxel's size."""
    width, height = camera.width, camera.height
    depth = max(float((camera.world_to_camera @ [*box.centre, 1])[2]), 1e-6)
    size = (
        2 * np.linalg.norm(box.matrix[:3, :3], axis=0).max() / (GRID - 1) * camera.fx / depth
    )  # of a voxel, in pixels
    # Voxels of several pixels are drawn in a smaller picture, in which they leave no gaps.
    step = max(1.0, size)
    small = camera.resized(max(1, round(width / step)), max(1, round(height / step)))
    if at is None or small.width != width:
        at = _pixels(box.grid(GRID), small)
    drawn = np.zeros(small.width * small.height, np.float32)
    np.maximum.at(drawn, at[at >= 0], occupied[at >= 0].astype(np.float32))
    drawn = cv2.morphologyEx(drawn.reshape(small.height, small.width), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    return cv2.resize(cv2.GaussianBlur(drawn, (0, 0), 0.7), (width, height), interpolation=cv2.INTER_LINEAR)


def _histogram(bins: np.ndarray, weight: np.ndarray) -> np.ndarray:
    counts = np.bincount(bins.ravel(), weight.ravel(), minlength=np.prod(LEVELS)).reshape(LEVELS)
    counts = gaussian_filter(counts, 1.0)
    return (counts / max(counts.sum(), 1e-9)).ravel()


def _weights(
    photo: Photo, prior: np.ndarray, colors: tuple[np.ndarray, np.ndarray] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return each pixel's weight (H, W) in the colours of the object, and in those of the surroundings.

    Where `colors` are known, pixels of the surroundings' colours count less as the object's: the shape may close a hole. A band about the
    shape belongs to neither. A part of the object that is not in the shape yet must not make its colours the surroundings'.
    """
    ours = prior * (prior > 0.5)
    if colors is not None:
        ours = ours * (colors[0] / (colors[0] + colors[1] + 1e-9))[photo.bins]
    band = max(3, round(0.06 * max(prior.shape))) | 1
    near = cv2.dilate((prior > 0.25).astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (band, band)))
    theirs = np.where(near > 0, 0.0, 1.0)
    # A stroke has few pixels, and says more than a guess.
    return np.where(photo.known > 0, 20.0, ours * (photo.known == 0)), np.where(
        photo.known < 0, 20.0, theirs * (photo.known == 0)
    )


def _learn_colors(
    photos: list[Photo], priors: list[np.ndarray], before: tuple[np.ndarray, np.ndarray] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the histograms of the object's and of the surroundings' colours, the mean over the photos. `before` are the last round's."""
    pairs = [
        [_histogram(photo.bins, weight) for weight in _weights(photo, prior, before)]
        for photo, prior in zip(photos, priors, strict=True)
    ]
    return tuple(np.mean(side, axis=0) for side in zip(*pairs, strict=True))


def _posterior(photo: Photo, prior: np.ndarray, colors: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return the probability that each pixel shows the object, by the colours of all photos, of this one, and by the shape's projection."""
    ours, theirs = (_histogram(photo.bins, weight) for weight in _weights(photo, prior, colors))
    ours = 0.5 * colors[0] + 0.5 * ours
    theirs = 0.3 * colors[1] + 0.7 * theirs if theirs.any() else colors[1]
    evidence = np.log((ours[photo.bins] + 1e-6) / (theirs[photo.bins] + 1e-6)).astype(np.float32)
    evidence = np.clip(cv2.GaussianBlur(evidence, (0, 0), max(prior.shape) / 256), -3, 3)
    odds = np.clip(prior, 0.1, 0.9)
    result = 1 / (1 + np.exp(-(evidence + 0.7 * np.log(odds / (1 - odds)))))
    return np.where(photo.known > 0, 0.999, np.where(photo.known < 0, 0.001, result))
