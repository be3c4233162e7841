"""Write a capture of a thin half sphere of metal, open at the top. Its outlines are those of a bowl with a lid."""

import json
from pathlib import Path

import cv2
import numpy as np

from benchmarks.scenes.analytic import ANGLE, F0, camera_matrix, sky
from refgs.color import srgb_encode
from tests.makers.priors import encoded

VIEWS = 28  # of which every seventh is held out


def bowl_normals(matrix: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute what a camera sees of the bowl: unit rays (H, W, 3), normals towards the camera (H, W, 3), and where it is (H, W).

    `matrix` is the camera-to-world matrix, with OpenGL's axes.
    """
    focal = 0.5 * size / np.tan(ANGLE / 2)
    x, y = np.meshgrid(np.arange(size) + 0.5 - size / 2, np.arange(size) + 0.5 - size / 2)
    ray = np.stack([x / focal, -y / focal, -np.ones_like(x)], axis=-1) @ matrix[:3, :3].T
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    along = ray @ matrix[:3, 3]
    root = along**2 - (matrix[:3, 3] @ matrix[:3, 3] - 1)
    hit, normal = np.zeros(x.shape, bool), np.zeros_like(ray)
    for side in (-1, 1):  # the near wall, else the far one
        point = matrix[:3, 3] + (side * np.sqrt(np.maximum(root, 0)) - along)[..., None] * ray
        new = (root > 0) & (point[..., 2] < 0) & ~hit
        normal[new] = -side * point[new]
        hit |= new
    return ray, normal, hit


def write_bowl_capture(folder: Path, size: int, normals: bool) -> None:
    """Write a NeRF-Blender capture of the bowl. If `normals` is true, its folder `normals` has the true ones of the training photos."""
    frames = {"train": [], "test": []}
    for i, step in enumerate((np.arange(VIEWS) + 0.5) / VIEWS):
        z, azimuth, split = 0.95 - 1.2 * step, i * np.pi * (3 - np.sqrt(5)), "train" if i % 7 else "test"
        matrix = camera_matrix(np.array([np.cos(azimuth), np.sin(azimuth), z / np.sqrt(1 - z * z)]))
        ray, normal, hit = bowl_normals(matrix, size)
        mirrored = ray - 2 * (ray * normal).sum(axis=-1, keepdims=True) * normal
        photo = np.dstack([srgb_encode(F0 * sky(mirrored)).clip(0, 1)[..., ::-1], hit])
        for kind, picture in (
            (split, np.rint(255 * photo).astype(np.uint8)),
            ("normals", encoded(normal @ matrix[:3, :3])),
        ):
            if kind == split or (normals and split == "train"):
                (folder / kind).mkdir(exist_ok=True, parents=True)
                cv2.imwrite(str(folder / kind / f"r_{i}.png"), picture)
        frames[split].append({"file_path": f"./{split}/r_{i}", "transform_matrix": matrix.tolist()})
    for split, entries in frames.items():
        text = json.dumps({"camera_angle_x": ANGLE, "frames": entries})
        (folder / f"transforms_{split}.json").write_text(text)
