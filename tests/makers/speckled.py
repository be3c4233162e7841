"""Photograph a speckled block on a speckled floor, by casting rays, for tests that find cameras from photos alone."""

from itertools import product

import numpy as np
from scipy.ndimage import map_coordinates

from refgs.capture.poses import OPENGL_TO_OPENCV
from refgs.capture.types import View

WIDTH, HEIGHT, FOCAL = 256, 192, 280.0
HALF, MIDDLE = np.array([0.6, 0.5, 0.4]), np.array([0, 0, 0.4])  # of the block


def about_z(turn: float) -> np.ndarray:
    """Return the rotation (4, 4) by `turn` radians about the vertical."""
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    return matrix


def speckled(
    pose: np.ndarray, turn: float = 0.0, seed: int = 0, room: bool = False, width: int = WIDTH, height: int = HEIGHT
) -> tuple[np.ndarray, np.ndarray]:
    """Ray-cast a block on a floor, both with random speckles: RGB (H, W, 3) uint8, and the block's mask (H, W) uint8.

    `pose` is the camera-to-world matrix. The block is turned by `turn` radians about the vertical; the floor is not. With `room`, a
    wall stands behind the block at y = 3, and the speckles of wall and floor are larger and fainter than the block's. The focal length is
    FOCAL for WIDTH, in proportion.
    """
    focal = FOCAL * width / WIDTH
    u, v = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([u / focal, -v / focal, -np.ones_like(u)], axis=-1) @ pose[:3, :3].T
    eye, turned = pose[:3, 3], about_z(turn)[:3, :3]
    at, way = eye @ turned, rays @ turned  # in the block's own coordinates
    ends = np.stack([(MIDDLE - HALF - at) / way, (MIDDLE + HALF - at) / way])
    near, far = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
    block = (near < far)[..., None]
    floor = np.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], 1e3)
    if room:
        floor = np.minimum(floor, np.where(rays[..., 1] > 0, (3 - eye[1]) / rays[..., 1], 1e3))
    behind = (eye + rays * floor[..., None]) * (0.375 if room else 1)
    points = np.where(block, at + way * near[..., None], behind)
    lattice = np.random.default_rng(seed).random((32, 32, 32, 3))
    grains = np.zeros((height, width, 3))
    for size, c in product((4.0, 13.0), range(3)):
        grains[..., c] += map_coordinates(lattice[..., c], size * points.transpose(2, 0, 1), order=1, mode="wrap")
    if room:
        grains = np.where(block, grains, 0.6 + 0.5 * (grains - 1))
    return (127 * grains).astype(np.uint8), np.where(block[..., 0], np.uint8(255), np.uint8(0))


def aligned(found: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Align points `found` (N, 3) with `true` by the best similarity transform (Umeyama 1991).

    Returns the aligned points and the rotation (3, 3).
    """
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    u, stretch, vt = np.linalg.svd(b.T @ a)
    flip = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u * flip @ vt
    return true.mean(axis=0) + (stretch @ flip) / (a**2).sum() * a @ rotation.T, rotation


def pose_errors(views: list[View], poses: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return how far the cameras of views are from true poses, after the best similarity transform: distances (N,), degrees (N,).

    The views are sorted by their photos' names. `poses` are camera-to-world matrices in that order.
    """
    views = sorted(views, key=lambda view: view.camera.name)
    true = np.array(poses)
    positions, rotation = aligned(np.array([view.camera.position for view in views]), true[:, :3, 3])
    turned = [
        view.camera.world_to_camera[:3, :3] @ rotation.T @ (pose @ OPENGL_TO_OPENCV)[:3, :3]
        for view, pose in zip(views, true, strict=True)
    ]
    cosines = (np.trace(turned, axis1=1, axis2=2) - 1) / 2
    return np.linalg.norm(positions - true[:, :3, 3], axis=1), np.degrees(np.arccos(np.clip(cosines, -1, 1)))
