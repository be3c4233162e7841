"""Photograph shapes of `distances` with a speckled surface, or as mirrors of speckled surroundings."""

import json
from itertools import product
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from refgs.camera import Camera
from refgs.capture.poses import OPENGL_TO_OPENCV
from refgs.geometry import explain, field, fog
from refgs.geometry.shape import Photo, Shape
from tests.makers.distances import depth, gradient, rays_of


def bowl(p: np.ndarray) -> np.ndarray:
    """Return the signed distance of points from a thick half shell, open at the top, with walls from 0.8 to 1."""
    return np.maximum(np.abs(np.linalg.norm(p, axis=-1) - 0.9) - 0.1, p[..., 2])


def speckles(points: np.ndarray, contrast: float = 1.0) -> np.ndarray:
    """Return grains in 0..1 (…, 3) that fill space, with the same mean for any `contrast`."""
    lattice = np.random.default_rng(0).random((32, 32, 32, 3))
    grains = np.zeros(points.shape)
    for size, c in product((4.0, 11.0), range(3)):
        at = size * np.moveaxis(points, -1, 0)
        grains[..., c] += map_coordinates(lattice[..., c], at, order=1, mode="grid-wrap") / 2
    return 0.5 + contrast * (grains - 0.5)


def photograph(camera: Camera, sdf, contrast: float = 1.0, mirror: bool = False) -> Photo:
    """Photograph a shape whose surface has speckles, or mirrors them at a distance, if `mirror` is true."""
    away, hit = depth(camera, sdf)
    rays = rays_of(camera)
    points = camera.position + rays * away[..., None]
    if mirror:
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        normals = gradient(sdf, points)
        points = rays - 2 * (rays * normals).sum(axis=-1, keepdims=True) * normals
    image = np.where(hit[..., None] > 0, speckles(points, contrast), 0)
    return Photo(np.rint(255 * image).astype(np.uint8), np.rint(255 * hit).astype(np.uint8), camera, 255)


def grid(sdf, side: int = 96, half: float = 1.1) -> Shape:
    """Return the shape whose points have a negative signed distance, on a grid of `side`³ voxels about the origin."""
    at = (np.arange(side) + 0.5) / side * 2 * half - half
    points = np.stack(np.meshgrid(at, at, at, indexing="ij"), axis=-1)
    return Shape(sdf(points) < 0, np.full(3, -half), np.full(3, 2 * half / side))


def half_ball(p: np.ndarray) -> np.ndarray:
    """Return the signed distance of points from the lower half of the unit ball: the visual hull of `bowl`."""
    return np.maximum(np.linalg.norm(p, axis=-1) - 1, p[..., 2])


BALL = np.array([0.3, 0.0, 0.4]), 0.25
"""Centre and radius of the ball of `on_a_disc`."""


def on_a_disc(p: np.ndarray) -> np.ndarray:
    """Return the signed distance of points from a ball that lies on a round disc."""
    q = np.stack([np.hypot(p[..., 0], p[..., 1]) - 0.9, np.abs(p[..., 2]) - 0.15], axis=-1)
    disc = np.minimum(q.max(axis=-1), 0) + np.linalg.norm(np.maximum(q, 0), axis=-1)
    return np.minimum(disc, np.linalg.norm(p - BALL[0], axis=-1) - BALL[1])


def carve_coarsely(monkeypatch) -> None:
    """Make `carve_hollows` use few voxels, rays and iterations, for speed."""
    monkeypatch.setattr(field, "SIDE", 64)
    monkeypatch.setattr(fog, "ITERATIONS", 80)
    monkeypatch.setattr(explain, "ITERATIONS", 80)
    monkeypatch.setattr(explain, "RAYS", 4096)


def write_capture(folder: Path, photos: list[Photo]) -> Path:
    """Write photos as a capture in NeRF-Blender's layout, in which all are training views. Returns the folder."""
    (folder / "train").mkdir(parents=True)
    frames = []
    for k, photo in enumerate(photos):
        cv2.imwrite(str(folder / "train" / f"r_{k}.png"), np.dstack([photo.image[..., ::-1], photo.alpha]))
        matrix = photo.camera.camera_to_world @ OPENGL_TO_OPENCV
        frames.append({"file_path": f"./train/r_{k}", "transform_matrix": matrix.tolist()})
    angle = 2 * np.arctan(0.5 * photos[0].camera.width / photos[0].camera.fx)
    text = json.dumps({"camera_angle_x": angle, "frames": frames})
    (folder / "transforms_train.json").write_text(text)
    return folder
