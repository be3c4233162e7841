"""Read nerfstudio and instant-ngp captures: one `transforms.json`, with intrinsics for all frames or for each frame, and optional masks.

`train_filenames` and `test_filenames` list the training and test photos. If the test list is missing, `val_filenames` is used.
`ply_file_path` names the file of structure-from-motion points.
"""

from pathlib import Path

import numpy as np

from refgs.capture.files import find_image
from refgs.capture.transforms import read_views
from refgs.capture.types import Split, View
from refgs.errors import InputError
from refgs.formats.colmap import FARTHEST
from refgs.formats.ply import read_ply
from refgs.formats.transforms import Frame, Transforms, read_transforms


def read_nerfstudio(folder: Path) -> tuple[list[View], np.ndarray | None, np.ndarray | None, list[str]]:
    """Read a nerfstudio or instant-ngp capture. Return its views, its points (M, 3), their colours (M, 3) in 0..1, and warnings.

    Everything is in the capture's coordinates. Points and colours are None if the capture names no file of points. Raises InputError.
    """
    file = folder / "transforms.json"
    found = read_transforms(file)
    train = None if found.train_filenames is None else set(found.train_filenames)
    test = set(found.test_filenames or found.val_filenames or ())

    def split(frame: Frame) -> Split | None:
        if frame.file_path in test:
            return "test"
        return "train" if train is None or frame.file_path in train else None

    frames, warnings = _without_deleted(found, file)
    views = read_views(file, [(frame, which) for frame in frames if (which := split(frame)) is not None])
    points, colors = _read_points(folder / found.ply_file_path) if found.ply_file_path else (None, None)
    return views, points, colors, warnings


def _without_deleted(found: Transforms, file: Path) -> tuple[list[Frame], list[str]]:
    """Drop frames whose photos are missing, but only from instant-ngp's files. Return the frames that are left, and warnings.

    Users of instant-ngp delete blurred photos and leave their frames in the file; instant-ngp ignores these frames. All frames are returned
    if another program wrote the file, or if more than half of the photos are missing. If a photo is missing then, the caller raises an
    error that names it.
    """
    frames = found.frames
    missing = [frame.path for frame in frames if find_image(file.parent / frame.path) is None]
    if not found.of_instant_ngp or not missing or 2 * len(missing) > len(frames):
        return frames, []
    kept = [frame for frame in frames if frame.path not in set(missing)]
    warning = f"{len(missing)} of the {len(frames)} images in {file.name} are missing and left out, first {missing[0]}"
    return kept, [warning]


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
