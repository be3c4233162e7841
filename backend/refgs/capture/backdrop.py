"""Find the plane that an object stands on or hangs on, and learn its colours, so that pixels of the plane can be told from the object's.

The photos are warped onto the plane, which gives a texture of it. A texel is the median of the photos that see it, because the object hides
different texels in each photo. A pixel does not show the plane if its colour differs from that of its texel. This works even where object
and plane share colours. Shadows that stand still are part of the texture. Reflections in a shiny floor move from photo to photo, so texels
that show them are uncertain.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from refgs.camera import Camera
from refgs.geometry.project import remap

SIDE = 512  # texels
REACH = 3.0  # half the texture's side, in radii of the region: low cameras see the object before a far part
ABOVE = 0.03  # in radii of the region: what is nearer to the plane is part of it
AGREE = 2.0  # times the median spread between photos, below which photos agree on a texel, so that nothing hides it
UNSURE = 5.0  # times the median spread between photos, from which on a texel's colour is not known
HIDDEN = 3.0  # odds of object to plane at texels that the shape covers in all photos
SEEN = 4  # photos that must see a texel
STEPS = 72.8  # of a byte for a change by a factor of e: log(255 + DARK) fits
DARK = 8.0  # added to 8-bit values before their logarithm, which noise would dominate otherwise
BIN = np.array([12.75, 5.0, 5.0], np.float32)  # in 8-bit Lab, as the bins of the colours' histograms
LEAST = np.array([2.0, 1.0, 1.0], np.float32)  # standard deviations that are taken for rounding
PARTS = (
    (0.97, np.zeros(3, np.float32)),
    (0.03, np.array([20, 2, 2], np.float32)),
)  # the plane as it was, and in a shadow or a highlight
GRAZING = 0.15  # sine of the angle to the plane, below which a photo's pixels smear over the texture


@dataclass(frozen=True, eq=False)
class Plane:
    """Hold the plane `normal` @ p = `distance`; its unit normal (3,) faces the object."""

    normal: np.ndarray
    distance: float

    def height(self, points: np.ndarray) -> np.ndarray:
        return points @ self.normal - self.distance


def find_plane(
    points: np.ndarray, centre: np.ndarray, radius: float, up: np.ndarray, positions: np.ndarray
) -> Plane | None:
    """Find the plane that carries the object: a floor or a wall with many structure-from-motion points, and hardly any points behind it.

    `points` (M, 3) are from structure from motion. `centre` and `radius` are a ball around the object, and `up` (3,) is the world's up
    direction. `positions` (N, 3) are the cameras' positions: a wall must have all of them in front of it. Return None if no plane is found.
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
        level = normal @ up / length
        normal *= np.sign(level if abs(level) > 0.87 else normal @ (positions.mean(axis=0) - a)) / length
        height = near @ normal - a @ normal
        on = np.abs(height) < 0.015 * radius
        if on.sum() <= best or (height < -0.04 * radius).mean() > 0.03:
            continue
        if normal @ up >= 0.87:  # a floor: within 30° of level, and below the object
            if normal @ (centre - a) < 0.1 * radius:
                continue
        elif (
            ((positions - a) @ normal).min() < 0.3 * radius
            or (height > 0.1 * radius).mean() < 0.1
            or on.sum() < 0.2 * len(near)
        ):
            continue  # not a wall: one has all cameras before it, and something hangs on it
        # What it carries is not part of it: its points reach beyond the object.
        if np.linalg.norm(near[on] - near[on].mean(axis=0), axis=1).mean() > 0.8 * radius:
            best, found = on.sum(), Plane(normal, float(a @ normal))
    return found


class Backdrop:
    """Hold the colours of a plane on a square grid of SIDE² texels around the object, and how much each colour differs between photos.

    Colours are logarithms of 8-bit values, scaled to 0..255. On this scale, a photo's exposure and white balance add a constant to each
    channel.
    """

    def __init__(self, plane: Plane, centre: np.ndarray, radius: float):
        self.plane, self.radius = plane, radius
        across = np.linalg.svd(plane.normal[None])[2][1:]  # two axes in the plane
        texel = 2 * REACH * radius / SIDE
        foot = centre - plane.height(centre) * plane.normal
        self.to_world = np.zeros((4, 3))  # from homogeneous texels
        self.to_world[:3, :2] = across.T * texel
        self.to_world[:3, 2] = foot - across.T @ np.full(2, texel * SIDE / 2)
        self.to_world[3, 2] = 1

    def before(self, points: np.ndarray) -> np.ndarray:
        """Mark the points (N, 3) clearly in front of the plane, as bool (N,)."""
        return self.plane.height(points) > ABOVE * self.radius

    def learn(self, images: list[np.ndarray], cameras: list[Camera], hidden: list[np.ndarray]) -> None:
        """Learn the plane's colours from photos (H, W, 3) uint8 RGB.

        `hidden` has a mask (H, W) for each photo, true at pixels that may show the object.
        """
        stack = np.full((SIDE * SIDE, 3, len(images)), 255, np.uint8)
        bare = np.zeros((SIDE * SIDE, len(images)), bool)  # photos in which nothing may hide a texel
        for index, (image, camera, hide) in enumerate(zip(images, cameras, hidden, strict=True)):
            at, valid = self._texels_in(camera)
            warped = remap(_logarithm(image), at)
            stack[valid.ravel(), :, index] = warped[valid]
            free = valid & (remap(hide.astype(np.uint8), at, outside=1) == 0)
            bare[:, index] = free.ravel()
        shown = stack[:, 0] < 255
        known = bare.sum(axis=1) >= SEEN
        covered = (shown.sum(axis=1) >= SEEN) & ~known
        color, spread = np.zeros((2, SIDE * SIDE, 3), np.float32)
        odds = np.full(SIDE * SIDE, np.nan, np.float32)
        if known.any():
            color[known], spread[known], offset = _median(stack[known], bare[known])
            color[covered], spread[covered], _ = _median(stack[covered], shown[covered], offset)
        deviation = spread.mean(axis=-1)
        usual = np.median(deviation[known]) if known.any() else 0.0
        # What the object hides has its colours, of other places in each photo. Where photos agree, the shape may cover bare plane.
        odds[covered & (deviation >= AGREE * usual)] = HIDDEN
        unsure = known & (deviation > UNSURE * usual)
        odds[unsure] = 1
        known &= ~unsure
        self.known, self.odds = known.reshape(SIDE, SIDE), odds.reshape(SIDE, SIDE)
        self.color, self.spread = color.reshape(SIDE, SIDE, 3), spread.reshape(SIDE, SIDE, 3)

    def likelihood(self, image: np.ndarray, camera: Camera, hidden: np.ndarray) -> np.ndarray:
        """Return how well each pixel's colour fits the bare plane, as float32 (H, W).

        A pixel's value depends on the texel that it would show if nothing hid the plane:

        - If the texel's colour is known, the value is the probability, 0..1, that the bare plane shows the pixel's colour, in a histogram
          with bins of size BIN (in Lab).
        - If the colour is unknown, but the texel has odds of object to bare plane, the value is minus these odds. This is the case for
          texels below the object.
        - If the texel has neither, or if there is no texel, the value is NaN.

        `hidden` (H, W) is true at pixels that may show the object. The photo's exposure and noise are measured at the other pixels. If
        fewer than 200 of those have a texel of known colour, all values are NaN.
        """
        texel, meets = self._pixels_on(camera)
        known = meets & (remap(self.known.astype(np.uint8), texel, cv2.INTER_NEAREST) > 0)
        color = remap(self.color, texel)
        spread = remap(self.spread, texel).mean(axis=-1)
        visible = known & ~hidden
        if visible.sum() < 200:
            return np.full(known.shape, np.nan, np.float32)
        color += np.median((_logarithm(image) - color)[visible], axis=0)
        expected = np.clip(DARK * np.exp(color / STEPS) - DARK, 0, 255).astype(np.float32)
        off = _lab(image.astype(np.float32)) - _lab(expected)
        spread = np.clip(spread / max(np.median(spread[visible]), 1e-3), 0.5, 4.0)[..., None]
        sigma = np.maximum(1.48 * np.median(np.abs(off / spread)[visible], axis=0), LEAST) * spread
        result = np.zeros(known.shape, np.float32)
        for part, wide in PARTS:
            width = np.hypot(sigma, wide)
            result += part * np.exp(-0.5 * ((off / width) ** 2).sum(axis=-1)) * np.prod(BIN / (2.507 * width), axis=-1)
        odds = remap(self.odds, texel, cv2.INTER_NEAREST, outside=np.nan)
        return np.where(known, np.minimum(result, 1), np.where(meets, -odds, np.float32(np.nan)))

    def _pixels_on(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Return each pixel's texel for `remap` (H, W, 2), and where there is one."""
        column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        ray = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones_like(row)], axis=-1)
        ray = ray @ camera.world_to_camera[:3, :3]
        fall = -(ray @ self.plane.normal)
        meets = fall > GRAZING / 2 * np.linalg.norm(ray, axis=-1)
        point = camera.position + ray * (self.plane.height(camera.position) / np.where(meets, fall, 1))[..., None]
        texel = (point - self.to_world[:3, 2]) @ np.linalg.pinv(self.to_world[:3, :2]).T - 0.5
        meets &= ((texel > 0) & (texel < SIDE - 1)).all(axis=-1)
        texel = np.where(meets[..., None], texel, -10).astype(np.float32)
        return texel, meets

    def _texels_in(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Return each texel's pixel for `remap` (SIDE, SIDE, 2), and where it is usable."""
        column, row = np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5)
        texel = np.stack([column, row, np.ones_like(row)], axis=-1)
        u, v, depth = np.moveaxis(texel @ (camera.projection @ self.to_world).T, -1, 0)
        away = camera.position - texel @ self.to_world[:3].T
        sine = away @ self.plane.normal / np.linalg.norm(away, axis=-1)
        safe = np.where(depth > 1e-9, depth, 1.0)
        u, v = u / safe, v / safe
        valid = (depth > 1e-9) & (sine > GRAZING) & (u > 0.5) & (v > 0.5)
        valid &= (u < camera.width - 0.5) & (v < camera.height - 0.5)
        at = np.stack([u - 0.5, v - 0.5], axis=-1).astype(np.float32)
        return np.where(valid[..., None], at, np.float32(-10)), valid


def _median(
    stack: np.ndarray, used: np.ndarray, offset: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return each texel's median (N, 3) and spread (N, 3) over the photos, and each photo's exposure by channel (3, photos).

    `stack` (N, 3, photos) holds the logarithms of the texels' values, and `used` (N, photos) is true where a photo's value counts. All
    results are logarithms, too. Spread is a standard deviation, estimated from the quartiles. A photo's exposure is how much its values
    exceed the medians. Exposures are fitted, unless `offset` (3, photos) gives them.
    """
    count = used.sum(axis=1)
    values = np.where(used[:, None], stack, np.float32(np.nan))
    if offset is None:
        # Photos see different texels, so exposures are fitted in turns with the texture.
        offset = np.zeros(stack.shape[1:], np.float32)
        every = max(1, len(values) // 20000)
        some, seen = values[::every], used[::every].any(axis=0)
        for _ in range(4):
            middle = np.nanmedian(some - offset, axis=2, keepdims=True)
            offset[:, seen] += np.nanmedian((some - offset - middle)[..., seen], axis=0)
    ordered = np.sort(values - offset, axis=2)  # NaN last
    low, middle, high = (
        np.take_along_axis(ordered, (part * (count - 1)).astype(int)[:, None, None], axis=2)[..., 0]
        for part in (0.25, 0.5, 0.75)
    )
    return middle, (high - low) / 1.35, offset


def _logarithm(image: np.ndarray) -> np.ndarray:
    return STEPS * np.log((image.astype(np.float32) + DARK) / DARK)


def _lab(image: np.ndarray) -> np.ndarray:
    """Convert RGB in 0..255 to Lab with L in 0..255, both float32."""
    return cv2.cvtColor(image / 255, cv2.COLOR_RGB2LAB) * np.array([2.55, 1, 1], np.float32)
