"""Read NeRF-Blender captures: `transforms_train.json` and `transforms_test.json` beside folders of RGBA PNGs.

NeRF-Synthetic and Shiny Blender have this layout. If the test file is missing, `transforms_val.json` is used for testing.

Shiny Blender also has true normals, NAME_normal.png. They are encoded as Ref-NeRF's code reads them (class `Blender` in multinerf's
`internal/datasets.py`). The scene `ball` of Shiny Blender has masks, NAME_alpha.png. Other images are ignored: depth, disparity, and
NeRF-Synthetic's NAME_normal_0000.png, whose encoding is undocumented.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from refgs.capture.images import read_alpha, read_image
from refgs.capture.reduce import reduced_map
from refgs.capture.transforms import read_views
from refgs.capture.types import Split, View
from refgs.errors import InputError
from refgs.formats.transforms import read_transforms


def read_nerf_blender(folder: Path) -> tuple[list[View], list[str]]:
    """Read a NeRF-Blender capture's views in its own coordinates, and warnings. Raises InputError."""
    views, warnings = _read(folder / "transforms_train.json", "train")
    for name in ("transforms_test.json", "transforms_val.json"):
        if (folder / name).is_file():
            tested, more = _read(folder / name, "test")
            return views + tested, warnings + more
    return views, warnings


def published_normals(view: View, max_side: int | None = None) -> tuple[np.ndarray, np.ndarray] | None:
    """Read a view's true normals and its mask. Return None if the data set has no normals.

    Normals (H, W, 3) are float32 unit vectors in the capture's world coordinates, 0 where the mask is 0. The mask (H, W) is float32 in
    0..1, all 1 if the view has none. Both have the size to which `load_view` reduces the photo. Raises InputError naming the file.
    """
    if view.normal_path is None:
        return None
    # Stored as n/2 + 1/2, not sRGB-encoded.
    normals = read_image(view.normal_path, is_data=True)[0].astype(np.float32) / 127.5 - 1
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
        normals, alpha = reduced_map(normals, alpha, fitted)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.where((alpha > 0)[..., None], normals / np.maximum(length, 1e-6), 0), alpha


def _read(file: Path, split: Split) -> tuple[list[View], list[str]]:
    views, warnings = read_views(file, [(frame, split) for frame in read_transforms(file).frames])
    normals = [view.image_path.with_name(f"{view.image_path.stem}_normal.png") for view in views]
    views = [replace(v, normal_path=n) if n.is_file() else v for v, n in zip(views, normals, strict=True)]
    return views, warnings
