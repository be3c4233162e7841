"""Captures as read, independent of their layout on disk."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from refgs.camera import Camera
from refgs.capture.box import Box
from refgs.capture.lens import Lens

Split = Literal["train", "test"]


@dataclass(frozen=True, eq=False)
class View:
    """Photo and its pinhole camera.

    `camera` is the pinhole camera of the full-size photo after `load_view` has undistorted it. Its name is the last part of the photo's
    path without suffix, unique within a split. `lens` is the lens model that distorted the photo file; None without distortion.
    `has_alpha` tells that the photo's own alpha channel is its mask; `mask_path` names a mask file instead. With `mask_below`, the mask
    file is a depth map: the object is where depth is below this fraction of the map's range. `normal_path` is a picture of the true
    normals, if the data set publishes them (`published_normals`).
    """

    camera: Camera
    image_path: Path
    mask_path: Path | None
    split: Split
    lens: Lens | None = None
    has_alpha: bool = False
    mask_below: float | None = None
    normal_path: Path | None = None

    @property
    def masked(self) -> bool:
        """Tell whether the view has a mask: a mask file, or the photo's alpha channel."""
        return self.mask_path is not None or self.has_alpha


@dataclass(frozen=True, eq=False)
class Capture:
    """Photos with cameras, in the run's frame: the coordinates of the training, with Z up.

    `to_capture` is a 4×4 float64 similarity, p_capture = to_capture @ p_run. For most NeRF-Blender captures it is the identity. For others
    the region of interest has radius 1 about the run's origin. If the user sets an up direction, the run's frame is rotated to it. `points`
    (M, 3) are structure-from-motion points with `point_colors` (M, 3), sRGB-encoded in 0..1; None if the layout has none. `centre` (3,) and
    `radius` are the region of interest: the object, or a room's foreground. `bounded` is a guess: True if the photos surround one object,
    False if they look at a place; `bounded_because` says why. If the user sets a `box` (in the run's frame), it narrows the region of
    interest, but changes no frame. A ball of radius `reach` about `centre` then holds the region of interest without the box; if there is
    no box, `reach` is `radius`. `warnings` are lines about what was left out or looks wrong.
    """

    folder: Path
    layout: str
    views: list[View]
    to_capture: np.ndarray
    points: np.ndarray | None
    point_colors: np.ndarray | None
    bounded: bool
    bounded_because: str
    centre: np.ndarray
    radius: float
    reach: float
    box: Box | None
    digest: str
    warnings: list[str]

    @property
    def train_views(self) -> list[View]:
        return [view for view in self.views if view.split == "train"]

    @property
    def test_views(self) -> list[View]:
        return [view for view in self.views if view.split == "test"]

    @property
    def masked(self) -> bool:
        """Tell whether every training view has a mask."""
        return all(view.masked for view in self.train_views)

    def fingerprint(self) -> str:
        """Return the SHA-256 of the files' names and sizes, and of the poses and intrinsics as read."""
        return self.digest
