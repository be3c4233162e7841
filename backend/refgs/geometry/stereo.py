"""Find the depth of an object's surface in photos by multi-view stereo: a plane sweep (Collins 1996) with normalised cross-correlation.

Each photo is compared with its neighbours on planes at many depths. If the neighbours, projected onto a plane, look like the photo, the
surface is near that plane. Photos are reduced first, because depth is only used to start a training.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import cv2
import numpy as np
import torch

from refgs.camera import Camera
from refgs.geometry.project import inside, pixel_rays, project

ACROSS = 90  # pixels across the object, in the reduced photos
PLANES = 64
WINDOW = 5  # pixels: the side of the patches that are compared
NEIGHBOURS = 6
BEST = 3  # of the neighbours: the others may not see the surface
ANGLES = 8, 45  # degrees from a photo to its neighbours, seen from the object
CONTRAST = 0.012  # of 1: patches that vary less tell nothing
SCORES = 0.5, 0.9  # mean correlation at which a depth begins to count, and counts in full
LEAD = 0.3  # of the best depth's correlation over that of others, at which a depth counts in full
APART = 4  # planes: depths this near are the same
TOLERANCE = 0.03  # of the object's radius: depths of two photos that differ by less agree
AGREE = 2  # neighbours whose depths must agree
OPAQUE = 0.8  # alpha
BISECTIONS = 3  # of the step between two planes


class Photo(NamedTuple):
    """Hold a photo's `image` (H, W, 3), uint8 mask `alpha`, camera and white value."""

    image: np.ndarray
    alpha: np.ndarray
    camera: Camera
    white: int


@dataclass(frozen=True, eq=False)
class Shape:
    """Hold a part of space, made of voxels, in which a surface must lie.

    `solid` (X, Y, Z), bool, tells which voxels belong to it. The first voxel has the corner `low` (3,) and the size `voxel` (3,).
    """

    solid: np.ndarray
    low: np.ndarray
    voxel: np.ndarray

    @cached_property
    def ball(self) -> tuple[np.ndarray, float]:
        """Return the centre (3,) and the radius of a ball around the shape."""
        voxels = np.argwhere(self.solid)
        first, last = self.low + voxels.min(axis=0) * self.voxel, self.low + (voxels.max(axis=0) + 1) * self.voxel
        return (first + last) / 2, float(np.linalg.norm(last - first)) / 2

    def fit(self, camera: Camera, across: int) -> Camera:
        """Reduce the camera, never enlarging it, until the shape's ball is `across` pixels wide."""
        centre, radius = self.ball
        distance = float(np.linalg.norm(camera.position - centre))
        side = across * max(camera.width, camera.height) * distance / (2 * radius * camera.fx)
        return camera.fitted(max(round(side), WINDOW))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Tell which points (..., 3) lie in a solid voxel."""
        at = np.floor((points - self.low) / self.voxel).astype(np.int32)
        within = np.all((at >= 0) & (at < self.solid.shape), axis=-1)
        within[within] = self.solid[tuple(at[within].T)]
        return within


class DepthMap(NamedTuple):
    """Hold a view's `depth` (h, w), and its `weight` (0..1), 0 where it is unknown."""

    camera: Camera
    depth: np.ndarray
    weight: np.ndarray

    def at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Look up world points (N, 3) in the map.

        Returns three arrays (N,): the surface's depth in each point's pixel, the weight of this depth, and the point's own depth. The
        weight is 0 for points outside of the picture.
        """
        pixels, away = project(self.camera, points)
        on = inside(self.camera, pixels, away)
        column, row = np.where(on[:, None], pixels, 0).astype(int).T
        row, column = row.clip(max=self.camera.height - 1), column.clip(max=self.camera.width - 1)
        return self.depth[row, column], np.where(on, self.weight[row, column], 0), away


class _Reduced(NamedTuple):
    picture: np.ndarray  # (h, w) float32, grey, sRGB-encoded, black beyond the mask
    alpha: np.ndarray  # (h, w) float32
    camera: Camera


def depth_maps(photos: Sequence[Photo], shape: Shape, unsure: np.ndarray) -> list[DepthMap]:
    """Estimate the depth of an object's surface in photos. The surface is looked for in `shape`, such as the masks' visual hull.

    Depth is only estimated in pixels whose rays enter the shape in a voxel of `unsure` (X, Y, Z), bool. In the other voxels, the caller
    knows the surface already.

    Returns a map for each photo that has at least BEST neighbours. A depth has a weight above 0 only under two conditions:

    - The neighbours show the photo's texture in the same place.
    - The depth maps of at least AGREE neighbours agree with the depth.

    Depths may be wrong in a flat mirror, because photos agree on its mirror images, which lie behind its surface. Photos of a curved mirror
    seldom agree.
    """
    centre, radius = shape.ball
    reduced = [_reduced(photo, shape) for photo in photos]
    near = _neighbours([photo.camera for photo in reduced], centre)
    chosen = [i for i, others in enumerate(near) if len(others) >= BEST]
    with ThreadPoolExecutor(torch.get_num_threads()) as threads:  # OpenCV works outside of Python's lock
        found = threads.map(lambda i: _sweep(reduced[i], [reduced[j] for j in near[i]], shape, unsure), chosen)
        maps = dict(zip(chosen, found, strict=True))
        agreed = partial(_agreed, near=near, maps=maps, tolerance=TOLERANCE * radius)
        return list(threads.map(agreed, chosen))


def _reduced(photo: Photo, shape: Shape) -> _Reduced:
    """Reduce a photo so that the shape is ACROSS pixels wide."""
    camera = shape.fit(photo.camera, ACROSS)
    size = camera.width, camera.height
    image, alpha = (cv2.resize(map_, size, interpolation=cv2.INTER_AREA) for map_ in (photo.image, photo.alpha))
    alpha = alpha.astype(np.float32) / 255
    return _Reduced(cv2.cvtColor(image.astype(np.float32) / photo.white, cv2.COLOR_RGB2GRAY) * alpha, alpha, camera)


def _neighbours(cameras: list[Camera], centre: np.ndarray) -> list[np.ndarray]:
    """Choose at most NEIGHBOURS neighbours for each camera, nearest in angle at `centre` first."""
    towards = np.stack([camera.position for camera in cameras]) - centre
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    angle = np.degrees(np.arccos((towards @ towards.T).clip(-1, 1)))
    order = np.argsort(angle, axis=1, kind="stable")
    return [row[(a[row] > ANGLES[0]) & (a[row] < ANGLES[1])][:NEIGHBOURS] for row, a in zip(order, angle, strict=True)]


def _sweep(photo: _Reduced, others: list[_Reduced], shape: Shape, unsure: np.ndarray) -> DepthMap:
    """Find depths where rays enter `unsure` voxels, by comparing the photo with `others` on planes."""
    # A pixel gets the depth of the plane on which the photo looks most like the others, among planes that its ray meets near or in a solid
    # voxel of the shape.
    camera, (centre, radius) = photo.camera, shape.ball
    middle = float(camera.world_to_camera[2, :3] @ centre + camera.world_to_camera[2, 3])
    planes = 1 / np.linspace(1 / max(middle - radius, radius / 100), 1 / (middle + radius), PLANES)
    rows, columns = np.nonzero(photo.alpha > OPAQUE)
    rays = pixel_rays(camera, rows, columns)
    within = shape.contains(camera.position + rays * planes[:, None, None])
    asked = replace(shape, solid=unsure).contains(_entry(camera, rays, planes, within, shape))
    rows, columns, within = rows[asked], columns[asked], within[:, asked]
    depth, weight = (np.zeros(photo.alpha.shape, np.float32) for _ in range(2))
    if not asked.any():
        return DepthMap(camera, depth, weight)
    within[:-1] |= within[1:]  # a surface may lie between two planes
    within[1:] |= within[:-1]
    score = np.where(within, _scores(photo, others, planes, rows, columns), -1)
    best, top = score.argmax(axis=0), score.max(axis=0)
    away = np.abs(np.arange(PLANES)[:, None] - best) > APART
    lead = top - np.where(away, score, -1).max(axis=0)
    low, high = SCORES
    depth[rows, columns] = planes[best]
    weight[rows, columns] = ((top - low) / (high - low)).clip(0, 1) * (lead / LEAD).clip(0, 1)
    return DepthMap(camera, depth, weight)


def _entry(camera: Camera, rays: np.ndarray, planes: np.ndarray, within: np.ndarray, shape: Shape) -> np.ndarray:
    """Return the points (N, 3) at which N rays of a camera enter a shape.

    `planes` (P,) are the depths of planes. `within` (P, N) is true for a plane and a ray if they meet in the shape.
    """
    first = within.argmax(axis=0)
    before, after = planes[np.maximum(first - 1, 0)], planes[first]
    for _ in range(BISECTIONS):
        half = (before + after) / 2
        hit = shape.contains(camera.position + rays * half[:, None])
        before, after = np.where(hit, before, half), np.where(hit, half, after)
    return camera.position + rays * after[:, None]


def _scores(
    photo: _Reduced, others: list[_Reduced], planes: np.ndarray, rows: np.ndarray, columns: np.ndarray
) -> np.ndarray:
    """Compare a photo with the photos `others`, projected onto P planes. The planes are at right angles to the axis of the photo's camera.

    `planes` (P,) are the depths of the planes. Returns an array (P, N) for the N pixels at `rows` and `columns`. Each value is the mean of
    the BEST largest correlations with `others`.
    """

    def mean(picture: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(picture, -1, (WINDOW, WINDOW), borderType=cv2.BORDER_REFLECT)

    def variance(picture: np.ndarray, average: np.ndarray) -> np.ndarray:
        return np.maximum(mean(picture * picture) - average * average, 0) + CONTRAST**2

    part = [slice(max(at.min() - WINDOW // 2, 0), at.max() + WINDOW // 2 + 1) for at in (rows, columns)]
    picture = photo.picture[tuple(part)]
    rows, columns = (at - where.start for at, where in zip((rows, columns), part, strict=True))
    camera = photo.camera.cropped(part[1].start, part[0].start, *picture.shape[::-1])
    inverse = np.linalg.inv(_intrinsics(camera))
    average = mean(picture)
    own, homographies = variance(picture, average), []
    for other in others:
        pose, matrix = other.camera.world_to_camera @ camera.camera_to_world, _intrinsics(other.camera)
        homographies.append((matrix @ pose[:3, :3] @ inverse, matrix @ pose[:3, 3:] @ inverse[2:]))
    found, size = np.empty((len(planes), len(rows)), np.float32), picture.shape[::-1]
    for plane, depth in zip(found, planes, strict=True):
        scores = []
        for (turn, shift), other in zip(homographies, others, strict=True):
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            moved = cv2.warpPerspective(other.picture, turn + shift / depth, size, flags=flags)
            mean_moved = mean(moved)
            together = mean(picture * moved) - average * mean_moved
            scores.append(together / np.sqrt(own * variance(moved, mean_moved)))
        plane[:] = np.sort([score[rows, columns] for score in scores], axis=0)[-BEST:].mean(axis=0)
    return found


def _intrinsics(camera: Camera) -> np.ndarray:
    """Return the intrinsic matrix (3, 3) for OpenCV, whose pixel centres are at integers."""
    return np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])


def _agreed(i: int, near: list[np.ndarray], maps: dict[int, DepthMap], tolerance: float) -> DepthMap:
    """Return depth map `i`, with weight 0 where fewer than AGREE neighbours agree within `tolerance`."""
    camera, depth, weight = maps[i]
    rows, columns = np.nonzero(weight)
    points = camera.position + pixel_rays(camera, rows, columns) * depth[rows, columns, None]
    agree = np.zeros(len(points), int)
    for j in near[i]:
        if j in maps:
            seen, known, away = maps[j].at(points)
            agree += (known > 0) & (np.abs(seen - away) < tolerance)
    weight = weight.copy()
    weight[rows, columns] *= agree >= AGREE
    return DepthMap(camera, depth, weight)
