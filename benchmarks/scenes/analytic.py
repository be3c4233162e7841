"""Metal balls under a smooth sky, photographed by a formula: a capture whose every answer is known, made without Blender."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

from refgs.color import srgb_encode

VIEWS, DISTANCE, ANGLE = 24, 4.0, 0.7  # training views, radii, radians
F0 = np.array([0.9, 0.6, 0.3])
BOUNCES = 4
ONE = np.array([[0.0, 0.0, 0.0, 1.0]])
TWO = np.array([[-0.6, 0.0, 0.0, 0.5], [0.6, 0.0, 0.0, 0.5]])


def sky(direction: np.ndarray) -> np.ndarray:
    """Linear radiance (…, 3): bright above, dark below, warmer to +x. Smooth, so that a low roughness hardly blurs it."""
    x, y, z = np.moveaxis(direction, -1, 0)
    return np.stack([0.5 + 0.3 * z + 0.2 * x, 0.5 + 0.35 * z + 0.1 * y, 0.5 + 0.4 * z - 0.2 * x], axis=-1)


def meet(origin: np.ndarray, ray: np.ndarray, balls: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether unit rays (P, 3) meet a ball (P,), and where they first do (P, 3), with the normal there (P, 3)."""
    apart = origin[:, None] - balls[:, :3]
    b = (apart * ray[:, None]).sum(-1)
    inside = b * b - ((apart**2).sum(-1) - balls[:, 3] ** 2)
    way = -b - np.sqrt(np.maximum(inside, 0))
    way[(inside <= 0) | (way < 1e-9)] = np.inf
    first = way.argmin(axis=1)
    hit = np.isfinite(way.min(axis=1))
    point = origin + np.where(hit, way.min(axis=1), 0)[:, None] * ray
    return hit, point, (point - balls[first, :3]) / balls[first, 3:]


def photo(
    matrix: np.ndarray,
    size: int,
    balls: np.ndarray = ONE,
    samples: int = 4,
    turning: bool = False,
    stops: float = 0.0,
) -> np.ndarray:
    """RGBA in 0..1 of balls (B, 4), centre and radius: mirrors with Schlick's Fresnel; alpha by `samples`² rays a pixel.

    The sky stands still, or turns with the camera, which is level, about z. The photo is exposed so many stops more.
    """
    focal = 0.5 * size / np.tan(ANGLE / 2)
    grid = (np.arange(size * samples) + 0.5) / samples
    x, y = np.meshgrid(grid - size / 2, grid - size / 2)
    ray = np.stack([x / focal, -y / focal, -np.ones_like(x)], axis=-1).reshape(-1, 3) @ matrix[:3, :3].T
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    origin, share = np.broadcast_to(matrix[:3, 3], ray.shape), np.ones_like(ray)
    for bounce in range(BOUNCES):
        hit, point, normal = meet(origin, ray, balls)
        if bounce == 0:
            seen = hit
        cosine = -(normal * ray).sum(-1, keepdims=True).clip(-1, 0)
        share = np.where(hit[:, None], share * (F0 + (1 - F0) * (1 - cosine) ** 5), share)
        origin, ray = point, np.where(hit[:, None], ray + 2 * cosine * normal, ray)
    azimuth = np.arctan2(matrix[1, 0], matrix[0, 0]) if turning else 0.0
    cosine, sine = np.cos(azimuth), np.sin(azimuth)
    ray = ray @ np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    color = np.where(seen[:, None], 2**stops * share * sky(ray), 0)
    blocks = (size, samples, size, samples)
    alpha = seen.reshape(blocks).mean(axis=(1, 3))
    color = color.reshape(*blocks, 3).sum(axis=(1, 3)) / np.maximum(seen.reshape(blocks).sum(axis=(1, 3)), 1)[..., None]
    return np.dstack([srgb_encode(color).clip(0, 1), alpha])


def camera_matrix(direction: np.ndarray) -> np.ndarray:
    """OpenGL camera-to-world at DISTANCE along a direction, looking at the origin, +z up."""
    back = direction / np.linalg.norm(direction)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, DISTANCE * back], axis=1)
    return matrix


def write_ball_capture(
    folder: Path,
    size: int,
    balls: np.ndarray = ONE,
    samples: int = 4,
    turning: bool = False,
    stops: tuple[float, ...] = (0.0,),
) -> None:
    """A NeRF-Blender capture of balls: 24 training and 4 test views. `stops` are the training views' by turns."""
    steps = np.arange(VIEWS + 4) + 0.5
    z = 0.9 - 1.5 * steps / len(steps)
    azimuth = steps * np.pi * (3 - np.sqrt(5))
    directions = np.stack([np.sqrt(1 - z * z) * np.cos(azimuth), np.sqrt(1 - z * z) * np.sin(azimuth), z], axis=1)
    frames = {"train": [], "test": []}
    for i, direction in enumerate(directions):
        split = "test" if i % 7 == 3 else "train"
        matrix = camera_matrix(direction)
        (folder / split).mkdir(exist_ok=True, parents=True)
        more = stops[i % len(stops)] if split == "train" else 0.0
        pixels = np.rint(photo(matrix, size, balls, samples, turning, more) * 255).astype(np.uint8)
        Image.fromarray(pixels).save(folder / split / f"r_{i}.png")
        frames[split].append({"file_path": f"./{split}/r_{i}", "transform_matrix": matrix.tolist()})
    for split, entries in frames.items():
        text = json.dumps({"camera_angle_x": ANGLE, "frames": entries})
        (folder / f"transforms_{split}.json").write_text(text)
