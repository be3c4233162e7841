"""Read NeRF-Blender captures: `transforms_train.json` and `transforms_test.json` beside folders of RGBA PNGs.

NeRF-Synthetic (see its README) and Shiny Blender have this layout. Shiny Blender adds NAME_normal.png, read as by the class `Blender` in
`internal/datasets.py` of multinerf, Ref-NeRF's code, and NAME_alpha.png, the mask of its scene `ball`. If the test file is missing, the
validation file is used for testing. Pictures that no frame names are ignored: depth, disparity, and NeRF-Synthetic's
NAME_normal_0000.png, whose encoding is undocumented.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from refgs.capture.images import read_alpha, read_image
from refgs.capture.transforms import read_frames, read_views
from refgs.capture.types import Split, View
from refgs.errors import InputError


def read_nerf_blender(folder: Path) -> list[View]:
    """Read the views, in the capture's frame. Raises InputError."""
    views = _read(folder / "transforms_train.json", "train")
    for name in ("transforms_test.json", "transforms_val.json"):
        if (folder / name).is_file():
            return views + _read(folder / name, "test")
    return views


def published_normals(view: View, max_side: int | None = None) -> tuple[np.ndarray, np.ndarray] | None:
    """Read a view's true normals and alpha, where the data set publishes them; None otherwise.

    Unit normals (H, W, 3) float32 in the capture's frame, zero off the surface; alpha (H, W) float32 in 0..1. Both have the size
    that `load_view` returns. Raises InputError naming the file.
    """
    if view.normal_path is None:
        return None
    normals = read_image(view.normal_path)[0].astype(np.float32) / 127.5 - 1  # n/2 + 1/2, not sRGB-encoded
    height, width = normals.shape[:2]
    camera = view.camera
    if (width, height) != (camera.width, camera.height):
        raise InputError(
            f"{view.normal_path}: the normals have {width}×{height} pixels but the photo {camera.width}×{camera.height}. "
            "Download the data set again."
        )
    mask = read_alpha(view)
    alpha = np.ones((height, width), np.float32) if mask is None else mask.astype(np.float32) / 255
    fitted = camera.fitted(max_side) if max_side else camera
    if fitted is not camera:
        size = (fitted.width, fitted.height)
        normals = cv2.resize(normals * alpha[..., None], size, interpolation=cv2.INTER_AREA)
        alpha = cv2.resize(alpha, size, interpolation=cv2.INTER_AREA)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.where((alpha > 0)[..., None], normals / np.maximum(length, 1e-6), 0), alpha


def _read(file: Path, split: Split) -> list[View]:
    views = read_views(file, [(frame, split) for frame in read_frames(file)[1]])
    normals = [view.image_path.with_name(f"{view.image_path.stem}_normal.png") for view in views]
    return [replace(v, normal_path=n) if n.is_file() else v for v, n in zip(views, normals, strict=True)]
