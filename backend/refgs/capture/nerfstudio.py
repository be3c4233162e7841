"""Read nerfstudio and instant-ngp captures: one `transforms.json` with intrinsics, shared or per frame, and optional masks.

`train_filenames`, `test_filenames` and `val_filenames` are nerfstudio's split. If the test list is missing, the validation list is used for
testing. `ply_file_path` names the file of structure-from-motion points.
"""

from pathlib import Path

import numpy as np
from plyfile import PlyData

from refgs.capture.files import find_image
from refgs.capture.transforms import Frame, read_frames, read_views
from refgs.capture.types import Split, View
from refgs.errors import InputError


def read_nerfstudio(folder: Path) -> tuple[list[View], np.ndarray | None, np.ndarray | None, list[str]]:
    """Read the views, points (M, 3) and their colours (M, 3) in 0..1, in the capture's frame, and warnings. Raises InputError."""
    file = folder / "transforms.json"
    shared, frames = read_frames(file)
    train = shared.get("train_filenames")
    test = shared.get("test_filenames") or shared.get("val_filenames") or []

    def split(frame: Frame) -> Split | None:
        name = frame.values["file_path"]
        if name in test:
            return "test"
        return "train" if train is None or name in train else None

    frames, warnings = _without_deleted(shared, frames, file)
    chosen = [(frame, split(frame)) for frame in frames]
    views = read_views(file, [(frame, which) for frame, which in chosen if which is not None])
    named = shared.get("ply_file_path")
    points, colors = _read_points(folder / named) if named else (None, None)
    return views, points, colors, warnings


def _without_deleted(shared: dict, frames: list[Frame], file: Path) -> tuple[list[Frame], list[str]]:
    """Drop frames whose photos are missing, and warn, in instant-ngp's files only.

    instant-ngp (its files have an `aabb_scale`) ignores frames of photos that were deleted as blurred, and its sample captures rely on it.
    All frames are kept, for the caller to report as an error, if more than half of the photos are missing or the file is not instant-ngp's.
    """
    missing = [frame.path for frame in frames if find_image(file.parent / frame.path) is None]
    if "aabb_scale" not in shared or not missing or 2 * len(missing) > len(frames):
        return frames, []
    kept = [frame for frame in frames if frame.path not in set(missing)]
    warning = f"{len(missing)} of the {len(frames)} images in {file.name} are missing and left out, first {missing[0]}"
    return kept, [warning]


def _read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        vertices = PlyData.read(path)["vertex"]
        points = np.stack([vertices[name] for name in "xyz"], axis=1).astype(np.float64)
        names = [prop.name for prop in vertices.properties]
        colors = np.full_like(points, 0.5)
        if "red" in names:
            colors = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=1) / 255.0
    except Exception as error:
        raise InputError(f"{path}: the points cannot be read ({error}). Remove ply_file_path to do without.") from error
    good = np.isfinite(points).all(axis=1)
    return points[good], colors[good]
