"""Read nerfstudio and instant-ngp captures: one `transforms.json`, with intrinsics for all frames or for each frame, and optional masks.

`train_filenames` and `test_filenames` list the training and test photos. If the test list is missing, `val_filenames` is used.
`ply_file_path` names the file of structure-from-motion points.
"""

import os
from pathlib import Path

import numpy as np

from refgs.capture.files import PHOTO_FOLDERS, Files
from refgs.capture.transforms import read_views
from refgs.capture.types import Split, View
from refgs.errors import InputError
from refgs.formats.colmap import FARTHEST
from refgs.formats.ply import read_ply
from refgs.formats.transforms import Frame, read_transforms


def read_nerfstudio(folder: Path) -> tuple[list[View], np.ndarray | None, np.ndarray | None, list[str]]:
    """Read a nerfstudio or instant-ngp capture. Return its views, its points (M, 3), their colours (M, 3) in 0..1, and warnings.

    Cameras and points are in the capture's coordinates. Points and colours are None if the capture names no file of points. Raises
    InputError.
    """
    file = folder / "transforms.json"
    found = read_transforms(file)
    files = Files(folder)

    def photo(name: str) -> Path | str:
        return files.find(name, *PHOTO_FOLDERS) or name

    train = None if found.train_filenames is None else {photo(name) for name in found.train_filenames}
    test = {photo(name) for name in found.test_filenames or found.val_filenames or ()}

    def split(frame: Frame) -> Split | None:
        named = photo(frame.file_path)
        return "test" if named in test else "train" if train is None or named in train else None

    views, warnings = read_views(
        file, [(frame, which) for frame in found.frames if (which := split(frame)) is not None]
    )
    points, colors = None, None
    if found.ply_file_path:
        path = files.find(found.ply_file_path, suffixes=False) or folder / found.ply_file_path
        if not Path(os.path.abspath(path)).is_relative_to(os.path.abspath(folder)):
            raise InputError(f"{path}: ply_file_path names a file outside of the capture. Move it there, or remove it.")
        points, colors = _read_points(path)
    return views, points, colors, warnings


def _read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        vertices = read_ply(path)["vertex"]
        points = np.stack([vertices[name] for name in "xyz"], axis=1).astype(np.float64)
        colors = np.full_like(points, 0.5)
        if "red" in (prop.name for prop in vertices.properties):
            colors = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=1).astype(np.float64) / 255
    except (KeyError, ValueError, TypeError) as error:
        what = f"it has no points with x, y and z ({error})"
        raise InputError(f"{path}: {what}. Export them again, or remove ply_file_path to do without.") from None
    good = (np.abs(points) <= FARTHEST).all(axis=1)
    return points[good], colors[good]
