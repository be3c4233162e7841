"""Find a capture's region of interest, a ball around what the cameras look at, and the run's frame (the world coordinates of training)."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from refgs.capture.box import Box
from refgs.capture.images import read_alpha
from refgs.capture.poses import in_frame
from refgs.capture.types import View
from refgs.errors import InputError
from refgs.geometry.project import inside, project

LOOK_OUT = "the cameras look outwards"
ONE_SIDED = "the cameras look at one place, from one side of it (no masks: a guess)"
NEAR = 100.0  # largest distance from the origin in radii; largest radius, and inverse of the smallest

WHITE_MASKS = "the masks are white (opaque) everywhere, so they are not used: make them anew, the object white on black"


@dataclass(frozen=True, eq=False)
class Region:
    """Region of interest: a ball, in the coordinates of the cameras.

    `bounded` is True if the photos have masks of one object, or surround one. It is False if they show a room or an open scene, or an
    object from one side (ONE_SIDED), with what is behind it. `because` gives the reason in words.
    """

    centre: np.ndarray
    radius: float
    bounded: bool
    because: str


def find_region(
    views: list[View], up: np.ndarray, points: np.ndarray | None, silhouettes: list[tuple[View, np.ndarray]]
) -> Region:
    """Find the region of interest: a ball around what the cameras look at.

    First estimate it from the poses. Then fit it to the masked object if there are masks, otherwise to the points. If
    that fails, keep the estimate. If the cameras look outwards, as in a room, return a ball around the cameras instead.

    `up` is the world's up direction. `points` are from structure from motion, or None. `silhouettes` are the pairs that
    `sample_silhouettes` returns.
    """
    centre, distances, miss = look_at_centre(views)
    ahead = float((distances > 0).mean())
    if ahead < 0.75:
        # The axes meet behind the cameras: they look outwards from the middle of a room.
        positions = np.array([view.camera.position for view in views])
        centre = positions.mean(axis=0)
        spread = float(np.linalg.norm(positions - centre, axis=1).max())
        return Region(centre, spread, False, LOOK_OUT)
    seen = np.abs(distances) * np.array([_half_view(view) for view in views])
    radius = float(np.median(seen))
    if silhouettes:
        carved = _carve(silhouettes, centre, 1.5 * float(seen.max()))
        if carved is None:
            return Region(centre, radius, False, "the masks do not agree on a solid object")
        return Region(*carved, True, "the photos have masks")
    if points is not None:
        centre, radius = _foreground(views, points, centre, radius)
    if miss > 0.25:
        return Region(centre, radius, False, "there are no masks and the cameras do not look at one place")
    if _one_sided(views, centre, up) > 0.6:
        return Region(centre, radius, False, ONE_SIDED)
    return Region(centre, radius, True, "the cameras surround one place they look at (no masks: a guess)")


def is_near(region: Region) -> bool:
    """Tell whether float32 coordinates are exact enough in a region.

    This holds if its radius is between 0.01 and 100, and if its centre is at most 100 radii from the origin.
    """
    return 1 / NEAR <= region.radius <= NEAR and float(np.linalg.norm(region.centre)) <= NEAR * region.radius


def region_in(box: Box, views: list[View], silhouettes: list[tuple[View, np.ndarray]]) -> Region:
    """Find the region of interest inside a box: a ball around the part of the masked object that is in the box.

    If there are no masks, or no point of the box is inside them, return the ball around the box. `silhouettes` are the pairs that
    `sample_silhouettes` returns. Raises InputError if no photo shows the box.
    """
    # About the box's centre, because `project` has 32 bits.
    to_box = np.eye(4)
    to_box[:3, 3] = -box.centre
    cameras = [in_frame(view.camera, to_box) for view in views]
    if not any(inside(camera, *project(camera, box.grid(5) - box.centre)).any() for camera in cameras):
        raise InputError("no photo shows the region: put its box where the cameras look")
    carved = _carve(silhouettes, box.centre, box.radius, box) if silhouettes else None
    return Region(*(carved or (box.centre, box.radius)), True, "a region was asked for")


def look_at_centre(views: list[View]) -> tuple[np.ndarray, np.ndarray, float]:
    """Find the point that the cameras look at: the point nearest to all optical axes, by least squares.

    Return the point (3,), its depth in each camera (N,), and a measure of how badly the axes meet: their median distance from the point,
    divided by the median depth. If the axes are parallel, the point stays finite, because it is pulled slightly towards the cameras.
    """
    positions = np.array([view.camera.position for view in views])
    middle = positions.mean(axis=0)
    positions = positions - middle  # first, because map coordinates have an origin far away
    forward = np.array([view.camera.world_to_camera[2, :3] for view in views])
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    pull = 1e-4 * len(views) * np.eye(3)
    centre = np.linalg.solve(across.sum(axis=0) + pull, np.einsum("nij,nj->i", across, positions))
    offset = centre - positions
    depth = np.einsum("ni,ni->n", forward, offset)
    miss = np.linalg.norm(np.einsum("nij,nj->ni", across, offset), axis=1)
    return centre + middle, depth, float(np.median(miss) / max(np.median(np.abs(depth)), 1e-300))


def warn_of_axes(layout: str, views: list[View]) -> list[str]:
    """Return a list with one warning if a JSON file's axes look like OpenCV's: cameras look away from where their optical axes meet.

    Return [] otherwise, and for layouts other than "nerfstudio" and "nerf-blender". Cameras that look out of a room cause no warning,
    because their axes hardly meet. Cameras on a rig cause a wrong warning if they look outwards and their axes meet. So this is only a
    warning: the file is still read with the axes of its format.
    """
    _, depth, miss = look_at_centre(views)
    if layout not in ("nerfstudio", "nerf-blender") or (depth < 0).mean() < 0.75 or miss > 0.25:
        return []
    what = f"{(depth < 0).sum()} of {len(views)} cameras look away from where their axes meet, as if the file had OpenCV's axes"
    return [
        f'{what}, not OpenGL\'s. If the photos show an object from around it, add "camera_convention": "opencv" to the file'
    ]


def up_direction(views: list[View]) -> np.ndarray:
    """Estimate the world's up direction (3,), in the coordinates of the cameras.

    It is perpendicular to the cameras' right axes, which stay horizontal when a camera looks up or down. If several directions are
    perpendicular to them, the mean of the cameras' up axes decides. That mean alone would be tilted if all cameras look down from one side.
    """
    axes = np.array([view.camera.world_to_camera[:3, :3] for view in views])
    right, up = axes[:, 0], -axes[:, 1]
    mean = up.mean(axis=0)
    if np.linalg.norm(mean) < 0.1:  # cameras are rolled every way: there is no up
        mean = np.array([0.0, 0.0, 1.0])
    weight = 0.02  # decides where the right axes leave directions open, and is too small to tilt up elsewhere
    result = np.linalg.solve(right.T @ right / len(right) + weight * np.eye(3), weight * mean)
    return result / np.linalg.norm(result)


def run_frame(up: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """Return the similarity transform (4, 4) from the run's frame to the capture's coordinates.

    In the run's frame, the ball given by `centre` and `radius` has radius 1 about the origin, and `up` is +Z.
    """
    # The run's x is as close to the capture's x as possible.
    x = np.eye(3)[np.argmin(np.abs(up))] if abs(up[0]) > 0.9 else np.array([1.0, 0.0, 0.0])
    x = x - up * (up @ x)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :3] = radius * np.stack([x, np.cross(up, x), up], axis=1)
    matrix[:3, 3] = centre
    return matrix


def sample_silhouettes(views: list[View], count: int = 24) -> list[tuple[View, np.ndarray]]:
    """Choose about `count` of the views that have masks, and reduce their masks to low resolution.

    The views are evenly spaced in the list. Return the pairs (view, reduced mask); a reduced mask is bool (H, W). Return an empty list if
    there are no masks, or if they are white everywhere. Raises InputError if all masks are empty.
    """
    masked = [view for view in views if view.masked]
    chosen = masked[:: max(1, len(masked) // count)]
    found = [(view, _small(alpha)) for view in chosen if (alpha := read_alpha(view)) is not None]
    if found and not any(mask.any() for _, mask in found) and not any(map(_shows_something, masked)):
        raise empty_masks([view.mask_path or view.image_path for view in masked])
    return [] if all(mask.all() for _, mask in found) else found


def _shows_something(view: View) -> bool:
    alpha = read_alpha(view)
    return alpha is not None and bool(alpha.any())


def empty_masks(files: list[Path]) -> InputError:
    """Make the error for a capture whose masks are all empty. `files` are the mask files, or photos with transparency."""
    first = files[0]
    return InputError(
        f"{first.parent}: all {len(files)} masks are empty, {first.name} too. Remove them, or make them anew, the object white on black."
    )


def _small(alpha: np.ndarray) -> np.ndarray:
    """Reduce a mask to about 128 pixels on its longer side, as bool.

    A pixel is True if any of the original pixels in it is more than half opaque.
    """
    step = max(1, max(alpha.shape) // 128)
    mask = (alpha > 127).astype(np.uint8)
    return cv2.dilate(mask, np.ones((step, step), np.uint8))[step // 2 :: step, step // 2 :: step] > 0


def _half_view(view: View) -> float:
    """Return tan(fov / 2) of a camera, for the smaller of its horizontal and vertical fields of view."""
    camera = view.camera
    return min(camera.width / camera.fx, camera.height / camera.fy) / 2


def _one_sided(views: list[View], centre: np.ndarray, up: np.ndarray) -> float:
    """Measure whether the cameras stand all around a point (0) or all on one side of it (1).

    The measure is the length of the mean of the unit vectors from the point to the cameras. Heights are ignored.
    """
    away = np.array([view.camera.position for view in views]) - centre
    away -= np.outer(away @ up, up)
    return float(np.linalg.norm((away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)).mean(axis=0)))


def _carve(
    silhouettes: list[tuple[View, np.ndarray]], centre: np.ndarray, half: float, box: Box | None = None
) -> tuple[np.ndarray, float] | None:
    """Return a ball (centre, radius) about the visual hull: the space that lies inside the masks of the photos. None if it is empty.

    Test a grid of points in the cube centre ± half. Then test a second grid, over the bounding box of the points that were kept. If `box`
    is given, only points inside it are kept.
    """
    kept, cell = _inside_masks(silhouettes, centre - half, centre + half, box)
    if len(kept):
        kept, cell = _inside_masks(silhouettes, kept.min(axis=0) - cell, kept.max(axis=0) + cell, box)
    if not len(kept):
        return None
    low, high = kept.min(axis=0) - cell, kept.max(axis=0) + cell
    centre = (low + high) / 2
    return centre, float(np.linalg.norm(kept - centre, axis=1).max() + 0.5 * np.linalg.norm(cell))


def _inside_masks(
    silhouettes: list[tuple[View, np.ndarray]], low: np.ndarray, high: np.ndarray, box: Box | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (K, 3) of a grid that are inside the masks, and the size (3,) of the grid's cells.

    The grid has 49³ points from `low` to `high`. A point is kept if at least half of the views (and at least two) see it, and if it is
    inside the mask in nine tenths of these. If `box` is given, only points inside it are kept.
    """
    axes = [np.linspace(low[i], high[i], 49) for i in range(3)]
    cell = np.array([axis[1] - axis[0] for axis in axes])
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = grid if box is None else grid[box.contains(grid)]
    inside, seen = np.zeros(len(grid)), np.zeros(len(grid))
    for view, mask in silhouettes:
        camera = view.camera.resized(mask.shape[1], mask.shape[0])
        local = grid @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        z = np.where(local[:, 2] > 0, local[:, 2], 1.0)
        u, v = camera.fx * local[:, 0] / z + camera.cx, camera.fy * local[:, 1] / z + camera.cy
        visible = (local[:, 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        seen += visible
        inside[visible] += mask[v[visible].astype(int), u[visible].astype(int)]
    return grid[(seen >= max(2, 0.5 * len(silhouettes))) & (inside >= 0.9 * seen)], cell


def _foreground(views: list[View], points: np.ndarray, centre: np.ndarray, radius: float) -> tuple[np.ndarray, float]:
    """Return a ball (centre, radius) about most of the structure-from-motion points near the given ball.

    Only points that at least half of the views see are used. If they are too few or too close together, the given ball is returned.
    """
    seen = np.zeros(len(points))
    for view in views:
        camera = view.camera
        local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        z = np.where(local[:, 2] > 0, local[:, 2], 1.0)
        u, v = camera.fx * local[:, 0] / z + camera.cx, camera.fy * local[:, 1] / z + camera.cy
        seen += (local[:, 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    near = points[(seen >= 0.5 * len(views)) & (np.linalg.norm(points - centre, axis=1) < 2 * radius)]
    if len(near) < 20:
        return centre, radius
    middle = np.median(near, axis=0)
    reach = float(np.quantile(np.linalg.norm(near - middle, axis=1), 0.95))
    return (middle, reach) if reach > 0.05 * radius else (centre, radius)
