"""NeRF-Blender: `transforms_train.json` and `transforms_test.json` beside folders of RGBA PNGs.

The layout of the NeRF paper's synthetic scenes, and of Shiny Blender. Without a test file the validation file takes
its place.
"""

from pathlib import Path

from refgs.capture.transforms import read_frames, read_views
from refgs.capture.types import View


def read_nerf_blender(folder: Path) -> list[View]:
    """The views in the capture's frame. Raises InputError."""
    views = _read(folder / "transforms_train.json", "train")
    for name in ("transforms_test.json", "transforms_val.json"):
        if (folder / name).is_file():
            return views + _read(folder / name, "test")
    return views


def _read(file: Path, split: str) -> list[View]:
    return read_views(file, [(frame, split) for frame in read_frames(file)[1]])
