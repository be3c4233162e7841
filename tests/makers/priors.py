"""Write true normals and depth of the metal ball's photos as other programs would, with axes, scale and shift of their own."""

from pathlib import Path

import cv2
import numpy as np

from benchmarks.scenes.analytic import ONE
from refgs.camera import Camera
from refgs.capture import read_capture
from tests.makers import scenes

OPENGL = (1, -1, -1)  # x right, y up, z to the camera


def true_maps(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Compute the ball's normals (H, W, 3) in the camera's axes, and its depth (H, W) along the camera's axis; 0 beside the ball."""
    _, hit, point, normal = scenes.meetings(camera, ONE)
    rotation, shape = camera.world_to_camera[:3, :3], (camera.height, camera.width)
    depth = np.where(hit, (point - camera.position) @ rotation[2], 0)
    return np.where(hit[:, None], normal @ rotation.T, 0).reshape(*shape, 3), depth.reshape(shape)


def encoded(normals: np.ndarray) -> np.ndarray:
    """Encode unit vectors (H, W, 3) as a program's PNG does: 8-bit BGR for OpenCV, black where there is none."""
    codes = np.rint((normals[..., ::-1] + 1) * 127.5) * normals.any(axis=-1, keepdims=True)
    return codes.astype(np.uint8)


def write_normals(capture: Path, signs: tuple[int, int, int] | None = OPENGL) -> None:
    """Write `normals/NAME.png` for the training photos. `signs` turn x right, y down, z away to the file's axes; None: world space."""
    (capture / "normals").mkdir()
    for view in read_capture(capture).train_views:
        normals, _ = true_maps(view.camera)
        normals = normals @ view.camera.world_to_camera[:3, :3] if signs is None else normals * signs
        cv2.imwrite(str(capture / "normals" / f"{view.camera.name}.png"), encoded(normals))


def write_depth(capture: Path, disparity: bool, scale: float = 1.0, shift: float = 0.0) -> None:
    """Write `depth/NAME.npy` for the training photos: a depth, or disparity, times `scale`, plus `shift`; 0 beside the ball."""
    (capture / "depth").mkdir()
    for view in read_capture(capture).train_views:
        _, depth = true_maps(view.camera)
        with np.errstate(divide="ignore"):
            values = scale * (1 / depth if disparity else depth) + shift
        np.save(capture / "depth" / f"{view.camera.name}.npy", np.where(depth > 0, values, 0).astype(np.float32))
