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

    `camera` is that of the full-size photo as `load_view` undistorts it. Its name is the last part of the photo's path without suffix,
    unique within a split. `lens` is the distorted lens of the file; None if the file is a pinhole's. `has_alpha` marks the photo's own
    alpha channel as its mask; a `mask_path` replaces it. With `mask_below` that file is a depth map, and the object is where depth is
    below this part of its range. `normal_path` is a picture of the true normals, if published (`published_normals`).
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
        """Tell whether the view has a mask, of either kind."""
        return self.mask_path is not None or self.has_alpha


@dataclass(frozen=True, eq=False)
class Capture:
    """Photos with cameras in the run's frame, which has Z up.

    `to_capture` is a 4×4 float64 similarity, p_capture = to_capture @ p_run. For most NeRF-Blender captures it is the identity;
    otherwise the region of interest has radius 1 about the run's origin. A wanted up direction rotates the run about its origin.
    `points` (M, 3) are structure-from-motion points with `point_colors` (M, 3), sRGB-encoded in 0..1; None if the layout has none.
    `centre` (3,) and `radius` are the region of interest: the object, or a room's foreground. `bounded` is a guess: the photos surround
    one object, or look at a place; `bounded_because` says why. A wanted `box` (in the run's frame) changes no frame, but narrows the
    region of interest; a ball of radius `reach` about `centre` then holds all that the photos show. Without a box, `reach` is `radius`.
    `warnings` are lines about what was left out or looks wrong.
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
