"""Carve hollows, which masks do not show, into a visual hull, if photos are explained better so."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, minimum_filter

from refgs.geometry.contact import contact
from refgs.geometry.explain import Explained
from refgs.geometry.field import Field
from refgs.geometry.fog import open_hull
from refgs.geometry.rays import Rays
from refgs.geometry.shape import Photo

PHOTOS = 32, 100  # fewest and most photos that are used: a quarter is held out
LONG = 0.05  # of the object's radius: from this contact on, the surface may be elsewhere
SHELL = -1.7, 0.3  # voxels from the hull's surface, within which a known surface is opaque
AWAY = 0.1  # cosine below which a camera does not see the hull's surface
ENOUGH = 0.05  # error of held-out photos, in sRGB codes, below which the hull explains them well enough
BETTER = 0.9  # of the hull's error: a carved shape must have less
AGAIN = 0.998  # of a carved shape's error: less is worth the seconds of another fog
APART = 1.5  # voxels: where two shapes differ by less, neither is preferred
SPREAD = 5.0  # voxels over which evidence is averaged


def carve_hollows(
    alpha: np.ndarray, low: np.ndarray, voxel: np.ndarray, photos: Sequence[Photo], seed: int = 0
) -> np.ndarray:
    """Carve hollows into a visual hull. Returns the fraction of each voxel that is left, (X, Y, Z) in 0..1.

    The hull is where `alpha` (X, Y, Z) is above one half. Voxels have the size `voxel` (3,), and the first has its corner at `low` (3,), in
    world units. A fog is learned in the hull (see `fog.open_hull`). The hull is carved as the fog tells where this explains held-out photos
    better (see `explain`), if the result explains them much better. Otherwise nothing is carved, because a fog also opens mirrors: what
    they mirror seems to lie behind them. Nothing is carved either if there are few photos, or if the hull explains them well. After the
    first fog, up to two more are learned in what is left: each opens a deep hollow a little further.

    The light must not move relative to the object. If it does, as on a turntable, highlights look like a surface on the turntable's axis.
    """
    whole = np.ones_like(alpha)
    photos = photos[:: -(-len(photos) // PHOTOS[1])]
    hull = Field.of(alpha, low, voxel)
    if len(photos) < PHOTOS[0] or not (hull.values < 0).any():
        return whole
    carved = choose(hull, photos, seed)
    if carved is hull:
        return whole
    at = [((np.arange(n) + 0.5) * voxel[a] + low[a] - hull.low[a]) / hull.voxel for a, n in enumerate(alpha.shape)]
    grid = np.meshgrid(*at, indexing="ij")
    left, before = (np.asarray(map_coordinates(f.values, grid, order=1, mode="nearest")) for f in (carved, hull))
    # Leave the hull's own voxels, which are finer, where nothing was carved.
    return 1 - (left - before).clip(0, 1) * (0.5 + left).clip(0, 1)


def known(hull: Field, photos: Sequence[Photo]) -> np.ndarray:
    """Mark the voxels (X, Y, Z) of a hull's surface, bool, where the object's surface is known.

    It is where outlines touch it (see `contact`), and where no camera looks: rays that get there from behind have met nothing else.
    """
    cameras = [photo.camera for photo in photos]
    length = minimum_filter(contact(hull.shape, [photo.alpha for photo in photos], cameras), 3)
    near = (hull.values > SHELL[0]) & (hull.values < SHELL[1])
    voxels = np.argwhere(near)
    outward = np.stack(np.gradient(gaussian_filter(hull.values, 1.5)), axis=-1)[near]
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-6)
    facing = np.full(len(voxels), -1.0)
    for camera in cameras:
        towards = (camera.position - hull.low) / hull.voxel - voxels
        np.maximum(facing, (outward * towards).sum(axis=1) / np.linalg.norm(towards, axis=1), out=facing)
    near[near] = (length[near] < LONG * hull.shape.ball[1]) | (facing < AWAY)
    return near


def choose(hull: Field, photos: Sequence[Photo], seed: int) -> Field:
    """Return the hull, or the hull carved as fogs tell, each in what the last one left, as long as held-out photos are explained better."""
    rays = Rays.of(photos, hull)
    shape, explained = hull, Explained(hull, rays, seed)
    if explained.mean < ENOUGH:
        return hull
    surface = known(hull, photos)
    for better in (BETTER, AGAIN, AGAIN):
        fog = open_hull(shape, surface, rays, seed)
        if not (fog.values < 0).any():
            break
        mixed = mix(shape, fog, explained, Explained(fog, rays, seed))
        carved = Explained(mixed, rays, seed)
        if carved.mean >= better * explained.mean:
            break
        shape, explained = mixed, carved
    return shape


def mix(hull: Field, fog: Field, first: Explained, second: Explained) -> Field:
    """Carve a hull as the fog does, where rays tell that this explains photos better."""
    rays = first.rays
    gain = first.error - second.error
    end = np.where(second.hit, second.distance, first.distance + 20)
    length = np.where(first.hit, end - first.distance, 0)
    differ = np.flatnonzero(np.isfinite(gain) & (np.abs(length) > APART))
    # Spread a ray's gain over the voxels between both surfaces.
    start, length = first.distance[differ], length[differ]
    origin, direction = rays.origin.numpy()[differ], rays.direction.numpy()[differ]
    shape, steps = hull.values.shape, 24
    total = np.zeros(hull.values.size)
    for step in range(steps):
        at = np.rint(origin + direction * (start + length * (step + 0.5) / steps)[:, None]).astype(int)
        on = ((at >= 0) & (at < shape)).all(axis=1)
        index, part = np.ravel_multi_index(tuple(at[on].T), shape), np.abs(length[on]) / steps
        total += np.bincount(index, part * gain[differ][on], hull.values.size)
    better = gaussian_filter((gaussian_filter(total.reshape(shape), SPREAD) > 0).astype(np.float32), 0.7)
    old, new = hull.values.clip(-4, 4), fog.values.clip(-4, 4)
    return Field(old + better * (new - old), hull.low, hull.voxel)
