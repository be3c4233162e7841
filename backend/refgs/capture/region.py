"""What the cameras look at: the centre and radius of interest, object or room, and the run's frame."""

from dataclasses import dataclass

import cv2
import numpy as np

from refgs.capture.box import Box
from refgs.capture.images import read_alpha
from refgs.capture.types import View
from refgs.errors import InputError
from refgs.geometry.project import inside, project

NEAR = 100.0  # radii from the origin, and units that a radius may be or be a part of


@dataclass(frozen=True, eq=False)
class Region:
    """A ball in the frame of the cameras it was found from; whether it is one object; and why, in words."""

    centre: np.ndarray
    radius: float
    bounded: bool
    because: str


def find_region(
    views: list[View], up: np.ndarray, points: np.ndarray | None, silhouettes: list[tuple[View, np.ndarray]]
) -> Region:
    """The region of interest from poses alone, then made sharper by masks, else by structure-from-motion points."""
    centre, distances, miss = look_at_centre(views)
    ahead = float((distances > 0).mean())
    if ahead < 0.75:
        # The axes meet behind the cameras: they look outwards, from the middle of a room.
        positions = np.array([view.camera.position for view in views])
        centre = positions.mean(axis=0)
        spread = float(np.linalg.norm(positions - centre, axis=1).max())
        return Region(centre, spread, False, "the cameras look outwards")
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
        return Region(centre, radius, False, "there are no masks and the cameras stand on one side")
    return Region(centre, radius, True, "the cameras surround one place they look at (no masks: a guess)")


def is_near(region: Region) -> bool:
    """Whether what is learned there, in float32, is as exact as in a ball of radius 1 about the origin, to a hundredth."""
    return 1 / NEAR <= region.radius <= NEAR and float(np.linalg.norm(region.centre)) <= NEAR * region.radius


def region_in(box: Box, views: list[View], silhouettes: list[tuple[View, np.ndarray]]) -> Region:
    """The region of interest where a box was asked for: what the masks show in it, else all of it. Raises InputError where no photo
    shows the box."""
    if not any(inside(view.camera, *project(view.camera, box.grid(5))).any() for view in views):
        raise InputError("no photo shows the region: put its box where the cameras look")
    carved = _carve(silhouettes, box.centre, box.radius, box) if silhouettes else None
    return Region(*(carved or (box.centre, box.radius)), True, "a region was asked for")


def look_at_centre(views: list[View]) -> tuple[np.ndarray, np.ndarray, float]:
    """The point nearest to all optical axes (least squares), the depth of each camera to it, and the axes' misses.

    The last is the median distance of the axes from the point over the median depth: 0 where they meet.
    A weak pull towards the cameras' middle keeps parallel axes from sending the point to infinity.
    """
    positions = np.array([view.camera.position for view in views])
    forward = np.array([view.camera.world_to_camera[2, :3] for view in views])
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    pull = 1e-4 * len(views) * np.eye(3)
    middle = positions.mean(axis=0)
    centre = np.linalg.solve(across.sum(axis=0) + pull, np.einsum("nij,nj->i", across, positions) + pull @ middle)
    offset = centre - positions
    depth = np.einsum("ni,ni->n", forward, offset)
    miss = np.linalg.norm(np.einsum("nij,nj->ni", across, offset), axis=1)
    return centre, depth, float(np.median(miss) / max(np.median(np.abs(depth)), 1e-12))


def up_direction(views: list[View]) -> np.ndarray:
    """The world's up in the cameras' frame, (3,): near the cameras' mean up, and across their right axes.

    Cameras that all look down tilt their mean up; a level camera's right axis is horizontal however it looks down.
    """
    axes = np.array([view.camera.world_to_camera[:3, :3] for view in views])
    right, up = axes[:, 0], -axes[:, 1]
    mean = up.mean(axis=0)
    if np.linalg.norm(mean) < 0.1:  # rolled every way: no up to be had
        mean = np.array([0.0, 0.0, 1.0])
    weight = 0.02  # enough to choose among directions that the right axes leave open, too little to tilt the rest
    result = np.linalg.solve(right.T @ right / len(right) + weight * np.eye(3), weight * mean)
    return result / np.linalg.norm(result)


def run_frame(up: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """run → capture, the 4×4 similarity that puts a ball at the origin with radius 1 and `up` along +Z."""
    # The horizontal axes: as near to the capture's x as can be.
    x = np.eye(3)[np.argmin(np.abs(up))] if abs(up[0]) > 0.9 else np.array([1.0, 0.0, 0.0])
    x = x - up * (up @ x)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :3] = radius * np.stack([x, np.cross(up, x), up], axis=1)
    matrix[:3, 3] = centre
    return matrix


def sample_silhouettes(views: list[View], count: int = 24) -> list[tuple[View, np.ndarray]]:
    """Small masks of some views spread over the capture; empty where masks are absent or fully opaque.

    Raises InputError where masks are all empty.
    """
    masked = [view for view in views if view.masked]
    chosen = masked[:: max(1, len(masked) // count)]
    masks = [_small(read_alpha(view)) for view in chosen]
    if masks and not any(mask.any() for mask in masks) and not any(read_alpha(view).any() for view in masked):
        name = (masked[0].mask_path or masked[0].image_path).name
        raise InputError(
            f"{masked[0].image_path.parent}: all {len(masked)} masks are empty, {name} too. Make them anew."
        )
    if all(mask.all() for mask in masks):
        return []
    return list(zip(chosen, masks, strict=True))


def _small(alpha: np.ndarray) -> np.ndarray:
    """A mask at 128 pixels or so, true where any of its pixels is more than half opaque."""
    step = max(1, max(alpha.shape) // 128)
    mask = (alpha > 127).astype(np.uint8)
    return cv2.dilate(mask, np.ones((step, step), np.uint8))[step // 2 :: step, step // 2 :: step] > 0


def _half_view(view: View) -> float:
    """The tangent of half the narrower field of view."""
    camera = view.camera
    return min(camera.width / camera.fx, camera.height / camera.fy) / 2


def _one_sided(views: list[View], centre: np.ndarray, up: np.ndarray) -> float:
    """Length of the mean horizontal direction from the centre to the cameras: 0 all round, 1 on one side."""
    away = np.array([view.camera.position for view in views]) - centre
    away -= np.outer(away @ up, up)
    return float(np.linalg.norm((away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)).mean(axis=0)))


def _carve(
    silhouettes: list[tuple[View, np.ndarray]], centre: np.ndarray, half: float, box: Box | None = None
) -> tuple | None:
    """Centre and radius of a coarse visual hull inside the cube centre ± half, of what is in the box if there is one; None where the
    masks carve all away.

    Twice: over the cube, then over what was left of it. A cell may miss a tenth of the masks that see it.
    """
    low, high = centre - half, centre + half
    for _ in range(2):
        axes = [np.linspace(low[i], high[i], 49) for i in range(3)]
        cell = np.array([axis[1] - axis[0] for axis in axes])
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        grid = grid if box is None else grid[box.contains(grid)]
        inside, seen = np.zeros(len(grid)), np.zeros(len(grid))
        for view, mask in silhouettes:
            camera = view.camera.resized(mask.shape[1], mask.shape[0])
            local = grid @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
            z = np.maximum(local[:, 2], 1e-9)
            u, v = camera.fx * local[:, 0] / z + camera.cx, camera.fy * local[:, 1] / z + camera.cy
            visible = (local[:, 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
            seen += visible
            inside[visible] += mask[v[visible].astype(int), u[visible].astype(int)]
        kept = grid[(seen >= max(2, 0.5 * len(silhouettes))) & (inside >= 0.9 * seen)]
        if len(kept) == 0:
            return None
        low, high = kept.min(axis=0) - cell, kept.max(axis=0) + cell
    centre = (low + high) / 2
    return centre, float(np.linalg.norm(kept - centre, axis=1).max() + 0.5 * np.linalg.norm(cell))


def _foreground(views: list[View], points: np.ndarray, centre: np.ndarray, radius: float) -> tuple[np.ndarray, float]:
    """Centre and radius of the points around the centre that at least half of the views have in the picture."""
    seen = np.zeros(len(points))
    for view in views:
        camera = view.camera
        local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        z = np.maximum(local[:, 2], 1e-9)
        u, v = camera.fx * local[:, 0] / z + camera.cx, camera.fy * local[:, 1] / z + camera.cy
        seen += (local[:, 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    near = points[(seen >= 0.5 * len(views)) & (np.linalg.norm(points - centre, axis=1) < 2 * radius)]
    if len(near) < 20:
        return centre, radius
    middle = np.median(near, axis=0)
    reach = float(np.quantile(np.linalg.norm(near - middle, axis=1), 0.95))
    return (middle, reach) if reach > 0.05 * radius else (centre, radius)
