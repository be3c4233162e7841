"""NeRF-Blender: `transforms_train.json` and `transforms_test.json` beside folders of RGBA PNGs.

The layout of NeRF-Synthetic (the README that comes with it), and of Shiny Blender, which adds NAME_normal.png, and for
its `ball` NAME_alpha.png (read by the class `Blender` of Ref-NeRF's code, `internal/datasets.py` of multinerf). Without
a test file the validation file takes its place. Depth, disparity and other pictures that no frame names are passed over.
"""

from pathlib import Path

import cv2
import numpy as np

from refgs.capture.images import read_alpha, read_image
from refgs.capture.transforms import read_frames, read_views
from refgs.capture.types import Capture, View
from refgs.errors import InputError


def read_nerf_blender(folder: Path) -> list[View]:
    """The views in the capture's frame. Raises InputError."""
    views = _read(folder / "transforms_train.json", "train")
    for name in ("transforms_test.json", "transforms_val.json"):
        if (folder / name).is_file():
            return views + _read(folder / name, "test")
    return views


def _read(file: Path, split: str) -> list[View]:
    return read_views(file, [(frame, split) for frame in read_frames(file)[1]])


def published_normals(
    capture: Capture, view: View, max_side: int | None = None
) -> tuple[np.ndarray, np.ndarray] | None:
    """The true normals that a data set brings for a view, and the object's coverage; None where it brings none.

    Unit normals (H, W, 3) float32 in the run's frame, zero where there is no surface, and alpha (H, W) in 0..1, of the
    size that `load_view` gives. NAME_normal.png holds n/2 + 1/2 in the capture's frame, which in this layout is the
    run's. Raises InputError naming the file.
    """
    file = view.image_path.with_name(f"{view.image_path.stem}_normal.png")
    if capture.layout != "nerf-blender" or not file.is_file():
        return None
    normals = read_image(file)[0].astype(np.float32) / 127.5 - 1
    height, width = normals.shape[:2]
    if (width, height) != (view.camera.width, view.camera.height):
        raise InputError(
            f"{file}: the normals have {width}×{height} pixels but the photo {view.camera.width}×{view.camera.height}. "
            "Download the data set again."
        )
    mask = read_alpha(view)
    alpha = np.ones((height, width), np.float32) if mask is None else mask.astype(np.float32) / 255
    camera = view.camera.fitted(max_side) if max_side else view.camera
    if camera is not view.camera:
        size = (camera.width, camera.height)
        normals = cv2.resize(normals * alpha[..., None], size, interpolation=cv2.INTER_AREA)
        alpha = cv2.resize(alpha, size, interpolation=cv2.INTER_AREA)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.where((alpha > 0)[..., None], normals / np.maximum(length, 1e-6), 0), alpha
