"""Carve hollows, which masks do not show, into a visual hull. A cell of voxels is hollow if photos see through it to a surface behind."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter, minimum_filter, zoom

from refgs.geometry.contact import contact
from refgs.geometry.stereo import DepthMap, Photo, Shape, depth_maps

MOST_PHOTOS = 100
LONG = 0.05  # of the object's radius: from this contact on, the surface may be elsewhere
CELL = 2  # voxels along each side of a cell that photos vote on
BAND = 0.04  # of the object's radius: how far from a depth cells may be on the surface
VOTE = 0.2  # weight from which on a photo counts as one that sees through a cell
PHOTOS = 0.06, 4  # part of the photos that must see through a cell, and how many at least
FREE = 0.65  # part of the votes that must be for a cell to be empty
SMOOTH = 2  # cells: the votes of neighbours count, too


def carve_hollows(alpha: np.ndarray, low: np.ndarray, voxel: np.ndarray, photos: Sequence[Photo]) -> np.ndarray:
    """Remove cells from a visual hull if photos see through them. Returns the fraction of each voxel that is left, (X, Y, Z) in 0..1.

    The hull is where `alpha` (X, Y, Z) is above one half. Voxels have the size `voxel` (3,), and the first has its corner at `low` (3,), in
    world units. A cell is a cube of CELL³ voxels. It is removed if enough photos see a surface behind it (see `stereo.depth_maps`), and few
    photos see a surface in it.

    The light must not move relative to the object. If it does, as on a turntable, highlights look like a surface on the turntable's axis.
    """
    shape = Shape(alpha > 0.5, np.asarray(low), np.asarray(voxel))
    cells = Shape(shape.solid[::CELL, ::CELL, ::CELL], shape.low, CELL * shape.voxel)
    left = np.ones(cells.solid.shape, np.float32)
    if cells.solid.any():
        photos = photos[:: -(-len(photos) // MOST_PHOTOS)]
        touched = contact(shape, [photo.alpha for photo in photos], [photo.camera for photo in photos])
        unsure = minimum_filter(touched, 3) > LONG * shape.ball[1]
        left -= _empty(cells, depth_maps(photos, shape, unsure), max(PHOTOS[0] * len(photos), PHOTOS[1]))
    scale = [n / cells for n, cells in zip(alpha.shape, left.shape, strict=True)]
    return np.asarray(zoom(gaussian_filter(left, SMOOTH), scale, order=1, mode="nearest", grid_mode=True))


def _empty(shape: Shape, maps: Sequence[DepthMap], least: float) -> np.ndarray:
    """Find a shape's empty voxels (X, Y, Z), which at least `least` maps see through."""
    # A depth map votes "empty" in cells in front of its surface and "full" in cells on it, with the weight of its depth there. Votes are
    # smoothed over neighbouring cells; a cell needs more than the fraction FREE of them.
    cells = np.argwhere(shape.solid)
    points = shape.low + (cells + 0.5) * shape.voxel
    band = BAND * shape.ball[1]
    free, surface, photos = (np.zeros(len(cells), np.float32) for _ in range(3))
    for one in maps:
        depth, weight, away = one.at(points)
        through = weight * (away < depth - band)
        free += through
        photos += through > VOTE
        surface += weight * (np.abs(away - depth) <= band)
    within = gaussian_filter(shape.solid.astype(np.float32), SMOOTH)

    def smooth(votes: np.ndarray) -> np.ndarray:
        grid = np.zeros(shape.solid.shape, np.float32)
        grid[tuple(cells.T)] = votes
        return gaussian_filter(grid, SMOOTH) / np.maximum(within, 1e-3)

    free, surface, photos = map(smooth, (free, surface, photos))
    return shape.solid & (free > FREE * (free + surface)) & (photos >= least)
