"""Find an object's silhouettes in photos with known cameras: the pixels that have the object's colours, and agree with a carved shape.

Photos are segmented together (after Campbell et al. 2010, "Automatic 3D object segmentation in multiple views"). Each voxel of a grid holds
the probability that it lies in the object. Two steps alternate:

- Project the voxels into the photos, and learn two colour histograms there: of the object, and of its surroundings.
- Keep the voxels at which nearly all photos show the object's colours.

GrabCut (OpenCV) then finds the exact edges. A segmentation model's probabilities, if there are any, are added to what the colours say, as
far as they agree with the shape. They also give the first shape, and the edges of the photos in which they agree.

A highlight can look like a hole, so two neighbouring photos are compared. A voxel in a hole shows the surroundings' colours in both photos.
A voxel at a highlight shows them in only one photo, because the highlight moves over the surface.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import cast

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter, label, minimum

from refgs.camera import Camera
from refgs.capture.backdrop import Backdrop
from refgs.capture.box import Box
from refgs.geometry.project import inside, project

GRID = 64  # voxels along an edge of the box
ROUNDS = 6  # of colours and carving; a real head's shape changes by less than 1 % in the last one
DISAGREE = 0.12  # part of the photos that may contradict a voxel: colours are ambiguous in some
DISAGREE_PLANE = 0.18  # the same before a plane: an object of its colours looks like it here and there
OPEN = 0.2  # probability below which two neighbouring photos see through a voxel, as through a ring, whatever the others say
NEAR = 0.2  # probability from which a pixel may be object, so that thin parts, which few voxels hold, are not lost
SEEN = 0.3  # part of the photos that must show a voxel
COUNTED = 0.1  # part of the largest object's volume, from which on another one is an object too
LEARNED = (0, 1, 3)  # rounds in which the plane's texture is learned
# Overlap of the model's object with the shape, up to which the model does not count, and from which on it counts fully.
DISTRUSTED, TRUSTED = 0.5, 0.9
BAND = 0.12  # of a photo's side around the shape, in which they are compared: other objects do not count
BESIDE_MODEL = 0.5  # of what colours say, which counts where the model counts fully: shadows and mirror images mislead colours more
HOLE = 0.3  # probability below which a hole that the coarse shape closes is one, as in a mug's handle
WIDER = 2.0  # times the guessed box, in which the model's object is looked for
BESIDE = 0.3  # part of the largest object's volume, weighted by nearness to the middle, from which on another one is in the box,
FARTHER = 0.5  # unless it is farther from the middle by this part of the largest one's radius
MARGIN = 1.3  # times the object that the model finds, for the box around it
UNKNOWN = 0.02  # likelihood of a colour that nothing is known of
LEVELS = (20, 32, 32)  # bins of the histograms, in Lab


@dataclass(frozen=True, eq=False)
class Photo:
    """Hold a reduced photo: `image` (H, W, 3) uint8 RGB, and its pinhole `camera`.

    `known` (H, W) int8 is 1 where an artist's mask or stroke marks the object, −1 where it marks the background, and 0 elsewhere. `salient`
    (H, W), if given, is the object's probability by a segmentation model.
    """

    image: np.ndarray
    camera: Camera
    known: np.ndarray
    salient: np.ndarray | None = None

    @cached_property
    def bins(self) -> np.ndarray:
        """Return the index of each pixel's bin in a flattened colour histogram, (H, W)."""
        lab = cv2.cvtColor(self.image, cv2.COLOR_RGB2LAB).astype(int)
        a, b = (np.clip((lab[..., i] - 128) // 5 + 16, 0, 31) for i in (1, 2))
        return (lab[..., 0] * LEVELS[0] // 256 * LEVELS[1] + a) * LEVELS[2] + b


@dataclass(frozen=True, eq=False)
class Shape:
    """Hold a carved shape: `occupied` (GRID³,) is the probability that a point of `box.grid(GRID)` lies in it.

    `objects` is the number of separate objects. `colors` are two histograms: of the object's colours, and of the surroundings'. `backdrop`
    is the plane that carries the object, or None.
    """

    box: Box
    occupied: np.ndarray
    objects: int
    colors: tuple[np.ndarray, np.ndarray]
    backdrop: Backdrop | None

    def bounds(self, to_frame: np.ndarray) -> Box:
        """Return the axis-parallel box around the shape in other coordinates, with a margin of 5 % of its size on each side.

        `to_frame` (4, 4) converts points to these coordinates: p_new = to_frame @ p.
        """
        points = self.box.grid(GRID)[self.occupied > 0.5] @ to_frame[:3, :3].T + to_frame[:3, 3]
        return _box_around(points, 1.1, 1e-9)

    def project(self, camera: Camera) -> np.ndarray:
        """Return the largest of the shape's probabilities along each pixel's ray, (H, W) float32."""
        return _project_voxels(self.occupied, self.box, camera)


def carve_object(photos: list[Photo], box: Box, fill: float, backdrop: Backdrop | None, progress) -> Shape | None:
    """Carve the object in a box out of the photos. Return None if nothing is left.

    The first guess is the model's, if photos have `salient`. Otherwise it is an ellipsoid of the fraction `fill` of the box's edges.
    `backdrop` is the plane that carries the object, or None; its colours are learned here. `progress(done, total)` is called after each
    round.
    """
    points = box.grid(GRID)
    pixels, seen, enough = _find_pixels(points, photos)
    allowed = enough if backdrop is None else enough & backdrop.before(points)
    if any(photo.salient is not None for photo in photos):
        occupied = np.clip(_by_model(photos, pixels, enough), 0, 0.85)
    else:
        occupied = np.clip(1.3 - 1.25 * _off_centre(points, box) / fill, 0.0, 0.85)
    occupied[~allowed] = 0
    pairs = _neighbours(photos, box.centre)
    disagree = DISAGREE if backdrop is None else DISAGREE_PLANE
    shape, colors = None, None
    for turn in range(ROUNDS):
        priors = [_project_voxels(occupied, box, photo.camera, at) for photo, at in zip(photos, pixels, strict=True)]
        if backdrop is not None and turn in LEARNED:
            hidden = [_hidden(prior) if turn else np.zeros(prior.shape, bool) for prior in priors]
            backdrop.learn([photo.image for photo in photos], [photo.camera for photo in photos], hidden)
        plains = [_plain(photo, prior, backdrop) for photo, prior in zip(photos, priors, strict=True)]
        colors = _learn_colors(photos, priors, plains, colors)
        votes = np.full((len(photos), len(points)), 255, np.uint8)  # bytes sort fast
        struck = np.zeros(len(points), bool)
        for vote, photo, prior, plain, at in zip(votes, photos, priors, plains, pixels, strict=True):
            shown = at >= 0
            posterior = _posterior(photo, prior, plain, colors)
            if backdrop is not None:  # a pixel may look like the plane by chance, a voxel's footprint less often
                posterior = cv2.GaussianBlur(posterior, (0, 0), 0.5 * _footprint(box, photo.camera))
            vote[shown] = (255 * posterior).astype(np.uint8).ravel()[at[shown]]
            struck[shown] |= (photo.known.ravel()[at[shown]] < 0) & (vote[shown] < 128)
        for pair in pairs:
            struck |= votes[pair].max(axis=0) < 255 * OPEN
        ordered = np.sort(np.ascontiguousarray(votes.T), axis=1)
        kept = ordered[np.arange(len(points)), (disagree * seen).astype(int)] / np.float32(255)
        kept[~allowed | struck] = 0
        field = gaussian_filter(kept.reshape(GRID, GRID, GRID), 0.7)
        parts, count = cast(tuple[np.ndarray, int], label(field > 0.5))
        if count == 0:
            return None
        sizes = np.bincount(parts.ravel())
        sizes[0] = 0
        large = sizes >= COUNTED * sizes.max()
        occupied = np.where(large[parts] | (parts == 0), field, 0).ravel()
        shape = Shape(box, occupied, int(large.sum()), colors, backdrop)
        progress(turn + 1, ROUNDS)
    return shape


def find_box(photos: list[Photo], box: Box) -> Box:
    """Return the box, parallel to the axes, around what the model finds near the middle of `box`; `box` itself if it finds nothing.

    A guessed box may cut the object, or be so large that the object has few voxels. Of several objects, the one at the middle is taken, and
    those that are about as large and hardly farther from the middle. Photos must have `salient`.
    """
    middle = box.centre
    for _ in range(2):  # the second time with voxels of the object's size
        wide = Box(box.matrix @ np.diag([WIDER, WIDER, WIDER, 1.0]))
        points = wide.grid(GRID)
        pixels, _, enough = _find_pixels(points, photos)
        likely = _by_model(photos, pixels, enough)
        parts, count = cast(tuple[np.ndarray, int], label(likely.reshape(GRID, GRID, GRID) > 0.5))
        if count == 0:
            return box
        parts = parts.ravel()
        near = np.maximum(1 - _off_centre(points, wide), 1e-6)
        weight = np.bincount(parts, np.where(parts > 0, near, 0))
        # Of each object, the distance from the middle to its nearest point; and a ball of the volume of the one that counts most.
        gap = minimum(np.linalg.norm(points - middle, axis=1), parts, np.arange(count + 1))
        first = weight.argmax()
        radius = (
            3 / (4 * np.pi) * (parts == first).mean() * np.prod(2 * np.linalg.norm(wide.matrix[:3, :3], axis=0))
        ) ** (1 / 3)
        taken = (weight >= BESIDE * weight[first]) & (gap <= gap[first] + FARTHER * radius)
        taken[0] = False
        voxel = np.abs(points[0] - points[-1]).max() / (GRID - 1)
        box = _box_around(points[taken[parts]], MARGIN, 2 * voxel)
    return box


def _box_around(points: np.ndarray, scale: float, margin: float) -> Box:
    """Return the box around points (N, 3), parallel to the axes, scaled by `scale` and wider by `margin` on each side."""
    low, high = points.min(axis=0), points.max(axis=0)
    matrix = np.diag([*(scale * (high - low) / 2 + margin), 1.0])
    matrix[:3, 3] = (low + high) / 2
    return Box(matrix)


def _off_centre(points: np.ndarray, box: Box) -> np.ndarray:
    """Return how far points (N, 3) are from the box's centre: 1 on the ellipsoid that touches its faces."""
    return np.linalg.norm(np.linalg.solve(box.matrix[:3, :3], (points - box.centre).T), axis=0)


def _find_pixels(points: np.ndarray, photos: list[Photo]) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Return each photo's result of `_pixels`, how many photos see each point (N,), and which points enough of them see (N,)."""
    pixels = [_pixels(points, photo.camera) for photo in photos]
    seen = cast(np.ndarray, sum((at >= 0).astype(int) for at in pixels))
    return pixels, seen, seen >= max(2, SEEN * len(photos))


def _by_model(photos: list[Photo], pixels: list[np.ndarray], enough: np.ndarray) -> np.ndarray:
    """Return the probability (GRID³,) that voxels are in the object, by the model alone.

    `pixels` and `enough` are results of `_find_pixels`. The model may take something else in some photos, or nothing. So each photo counts
    as far as what it takes holds what all photos agree on.
    """
    shown = [
        (here := at >= 0, photo.salient.ravel()[at[here]])
        for photo, at in zip(photos, pixels, strict=True)
        if photo.salient is not None
    ]

    def agreed(counts: np.ndarray) -> np.ndarray:
        total, whole = np.zeros((2, len(enough)))
        for (here, salient), count in zip(shown, counts, strict=True):
            total[here] += count * salient
            whole[here] += count
        mean = np.where(enough, total / np.maximum(whole, 1e-6), 0)
        # Relative to the largest mean: in some photos the model may take something else.
        return np.clip((mean / max(mean.max(), 1e-6) - 0.6) / 0.4, 0, 1)

    first = agreed(np.ones(len(shown)))
    return agreed(np.array([first[here] @ salient / max(first[here].sum(), 1e-6) for here, salient in shown]))


def cut_out(photo: Photo, shape: Shape) -> np.ndarray:
    """Find the silhouette's exact edge in a photo. Return the mask (H, W) uint8, 0 or 255."""
    prior = shape.project(photo.camera)
    plain = _plain(photo, prior, shape.backdrop)
    posterior = _posterior(photo, prior, plain, shape.colors)
    likely = posterior > 0.5
    margin = max(3, round(0.03 * max(prior.shape))) | 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (margin, margin))
    solid = (prior > 0.5).astype(np.uint8)
    inner = kernel if plain is None else np.ones((5, 5), np.uint8)
    core = cv2.erode(solid, inner, borderValue=(1,)) > 0
    around = cv2.dilate(((prior > NEAR) | (photo.known > 0)).astype(np.uint8), kernel) > 0
    labels = np.where(likely, np.uint8(cv2.GC_PR_FGD), np.uint8(cv2.GC_PR_BGD))
    labels[core & likely] = cv2.GC_FGD
    if plain is not None:  # GrabCut knows colours only
        labels[(plain > 0) & (posterior < 0.1)] = cv2.GC_BGD  # by chance on the shape, too: its core wins
        labels[core | ((prior > 0.5) & (posterior > 0.9))] = cv2.GC_FGD
    labels[~around] = cv2.GC_BGD
    labels[photo.known > 0] = cv2.GC_FGD
    labels[photo.known < 0] = cv2.GC_BGD
    if photo.salient is not None and _trust(photo.salient, prior) > 0.5:  # it knows the edge better than colours do
        mask = _only_connected(
            (likely | (core & (posterior > 0.2))) & around, (solid > 0) & (posterior > HOLE), photo.known
        )
        return np.where(mask, np.uint8(255), np.uint8(0))
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
            cv2.grabCut(image, inner, (0, 0, 0, 0), np.zeros((1, 65)), np.zeros((1, 65)), 2, cv2.GC_INIT_WITH_MASK)
            labels[part] = inner
    mask = _only_connected(labels & 1, solid > 0, photo.known)
    return np.where(mask, np.uint8(255), np.uint8(0))


def _only_connected(mask: np.ndarray, solid: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Drop the parts of a mask that do not touch the shape's projection `solid`, and close the holes that the shape does not have.

    The closed holes are highlights, which GrabCut took for surroundings. There are two exceptions. A part also stays if `known` is 1
    somewhere in it, and a hole stays open if `known` is −1 somewhere in it. Returns bool (H, W).
    """
    _, parts = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    kept = np.isin(parts, np.unique(parts[(mask > 0) & (solid | (known > 0))])) & (mask > 0)
    _, holes = cv2.connectedComponents((~kept).astype(np.uint8), connectivity=4)
    edge = np.concatenate([holes[0], holes[-1], holes[:, 0], holes[:, -1]])
    opened = np.isin(holes, np.unique([*edge, *holes[~kept & (~solid | (known < 0))]]))
    return kept | ~opened


def _neighbours(photos: list[Photo], centre: np.ndarray) -> np.ndarray:
    """Pair each photo with a neighbour, by the directions of their cameras from `centre`.

    A neighbour's direction differs by at least 5° and at most 40°. The neighbour with the least difference is chosen.

    Returns indices of photos (N, 2). Photos without a neighbour are left out.
    """
    away = np.array([photo.camera.position for photo in photos]) - centre
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(away @ away.T, -1, 1)))
    angle[(angle < 5) | (angle > 40)] = np.inf
    pairs = np.column_stack([np.arange(len(photos)), angle.argmin(axis=1)])[np.isfinite(angle.min(axis=1))]
    return np.unique(np.sort(pairs, axis=1), axis=0)


def _pixels(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the flat index (row · width + column) of the pixel that shows each point, (N,). It is −1 if no pixel does."""
    at, depth = project(camera, points)
    shown = inside(camera, at, depth)
    column, row = np.where(shown[:, None], at, 0).astype(np.int32).T
    index = np.minimum(row, camera.height - 1) * camera.width + np.minimum(column, camera.width - 1)
    return np.where(shown, index, -1)


def _footprint(box: Box, camera: Camera) -> float:
    """Return how many pixels wide a voxel at the box's centre is in the photo."""
    depth = max(float((camera.world_to_camera @ [*box.centre, 1])[2]), 1e-6)
    return 2 * np.linalg.norm(box.matrix[:3, :3], axis=0).max() / (GRID - 1) * camera.fx / depth


def _project_voxels(occupied: np.ndarray, box: Box, camera: Camera, at: np.ndarray | None = None) -> np.ndarray:
    """Return the largest value in `occupied` (GRID³,) along each pixel's ray, (H, W) float32, blurred by about the size of a voxel.

    `at` may give the result of `_pixels` for all voxels, so that it is not computed again.
    """
    width, height = camera.width, camera.height
    # Voxels of several pixels are drawn in a smaller picture, in which they leave no gaps.
    step = max(1.0, _footprint(box, camera))
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


def _hidden(prior: np.ndarray) -> np.ndarray:
    """Mark the pixels, bool (H, W), at which the object may hide the plane: the shape's projection `prior` (H, W), with a margin."""
    margin = max(3, round(0.02 * max(prior.shape))) | 1
    return cv2.dilate((prior > 0.3).astype(np.uint8), np.ones((margin, margin), np.uint8)) > 0


def _plain(photo: Photo, prior: np.ndarray, backdrop: Backdrop | None) -> np.ndarray | None:
    """Return how well each pixel's colour fits the bare plane, (H, W): see `Backdrop.likelihood`. Return None if there is no plane."""
    return None if backdrop is None else backdrop.likelihood(photo.image, photo.camera, _hidden(prior))


def _surroundings(ours: np.ndarray, theirs: np.ndarray, plain: np.ndarray | None) -> np.ndarray:
    """Return the likelihood of each pixel's colour if the pixel shows the surroundings, (H, W).

    `ours` and `theirs` (H, W) are the colour's likelihoods by the histograms of the object and of the surroundings. `plain` (H, W) is the
    result of `Backdrop.likelihood`, or None. There are three cases:

    - `plain` is 0 or more: the likelihood of the colour on the bare plane. The result is mostly `plain`.
    - `plain` is negative: minus the odds of object to plane. The result is `ours` divided by these odds.
    - `plain` is NaN or None: nothing is known of the plane. The result is `theirs`.
    """
    if plain is None:
        return theirs
    hidden = -ours / np.where(plain < 0, plain, -1)
    return np.where(np.isnan(plain), theirs, np.where(plain < 0, hidden, 0.95 * plain + 0.05 * theirs))


def _weights(
    photo: Photo, prior: np.ndarray, plain: np.ndarray | None, colors: tuple[np.ndarray, np.ndarray] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return two weights of each pixel (H, W): in the histogram of the object's colours, and in that of the surroundings'.

    `prior` (H, W) is the shape's projection, and `plain` (H, W) the result of `Backdrop.likelihood`, or None. The shape may wrongly close a
    hole. Therefore a pixel in the shape has a smaller weight if its colour fits the surroundings better (by the histograms `colors`). The
    shape may also lack parts of the object, whose colours must not be learned as the surroundings'. Therefore pixels in a band around the
    shape have no weight in either histogram.
    """
    ours = prior * (prior > 0.5)
    if colors is not None:
        own = colors[0][photo.bins]
        ours = ours * (own / (own + _surroundings(own, colors[1][photo.bins], plain) + 1e-9))
    elif plain is not None:
        ours = ours * (UNKNOWN / (UNKNOWN + np.where(plain >= 0, plain, UNKNOWN)))
    band = max(3, round(0.06 * max(prior.shape))) | 1
    near = cv2.dilate((prior > 0.25).astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (band, band)))
    theirs = np.where(near > 0, 0.0, 1.0)
    # A stroke has few pixels, and says more than a guess.
    return np.where(photo.known > 0, 20.0, ours * (photo.known == 0)), np.where(
        photo.known < 0, 20.0, theirs * (photo.known == 0)
    )


def _learn_colors(
    photos: list[Photo],
    priors: list[np.ndarray],
    plains: list[np.ndarray | None],
    before: tuple[np.ndarray, np.ndarray] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return two histograms, averaged over the photos: of the object's colours, and of the surroundings'.

    `priors` (H, W) are the shape's projections, `plains` the results of `_plain`. `before` are the histograms of the last round, or None in
    the first.
    """
    pairs = [
        [_histogram(photo.bins, weight) for weight in _weights(photo, prior, plain, before)]
        for photo, prior, plain in zip(photos, priors, plains, strict=True)
    ]
    return tuple(np.mean(side, axis=0) for side in zip(*pairs, strict=True))


def _posterior(
    photo: Photo, prior: np.ndarray, plain: np.ndarray | None, colors: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Return the probability that each pixel shows the object, (H, W).

    Two sources are combined. One is the shape's projection `prior`. The other is the photo: the pixel's colour, and how well it fits the
    histograms of all photos, those of this photo, and the bare plane; and the model's probability, if the photo has `salient`. The model
    counts as much as it agrees with the shape: `_trust`.
    """
    evidence = np.clip(_of_colors(photo, prior, plain, colors), -3, 3)
    if photo.salient is not None:
        # The model misses parts that colours find, and finds parts that have no colours of their own.
        trust = _trust(photo.salient, prior)
        evidence *= 1 + trust * (BESIDE_MODEL - 1)
        evidence += trust * np.clip(_of_model(photo.salient), -3, 3)
    odds = np.clip(prior, 0.1, 0.9)
    result = 1 / (1 + np.exp(-(evidence + 0.7 * np.log(odds / (1 - odds)))))
    return np.where(photo.known > 0, 0.999, np.where(photo.known < 0, 0.001, result))


def _trust(salient: np.ndarray, prior: np.ndarray) -> float:
    """Return how far a photo's `salient` (H, W) agrees with the shape's projection `prior` (H, W), 0..1.

    Agreement is the overlap (intersection over union) near the shape: 0 up to DISTRUSTED, as where the model took something else, and 1
    from TRUSTED on.
    """
    inside = prior > 0.5
    band = max(3, round(BAND * max(prior.shape))) | 1
    near = cv2.dilate(inside.astype(np.uint8), np.ones((band, band), np.uint8)) > 0
    overlap = np.where(inside, salient, 0).sum() / max((inside | (near & (salient > 0.5))).sum(), 1)
    return float(np.clip((overlap - DISTRUSTED) / (TRUSTED - DISTRUSTED), 0, 1))


def _of_model(salient: np.ndarray) -> np.ndarray:
    likely = np.clip(salient, 0.01, 0.99)
    return np.log(likely / (1 - likely))


def _of_colors(
    photo: Photo, prior: np.ndarray, plain: np.ndarray | None, colors: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Return the logarithm of the odds that each pixel shows the object, by its colour, (H, W)."""
    ours, theirs = (_histogram(photo.bins, weight) for weight in _weights(photo, prior, plain, colors))
    ours = 0.5 * colors[0] + 0.5 * ours
    theirs = 0.3 * colors[1] + 0.7 * theirs if theirs.any() else colors[1]
    ours, theirs = ours[photo.bins], theirs[photo.bins]
    if plain is not None:  # where the plane is known, an object of the surroundings' colours can be told from it
        ours = 0.7 * ours + 0.3 * theirs
    theirs = _surroundings(ours, theirs, plain)
    evidence = np.log((ours + 1e-6) / (theirs + 1e-6)).astype(np.float32)
    return cv2.GaussianBlur(evidence, (0, 0), max(prior.shape) / 256)
