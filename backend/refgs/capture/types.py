"""What a capture is once it has been read, whatever layout it had on disk."""

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
    """One photo and the pinhole camera that sees it once it has been loaded with `load_view`.

    `camera` covers the full-size photo after undistortion. Its name is the last part of the photo's path without the
    extension, unique within a split. `lens` is the distorted lens of the file, None where the file is already a
    pinhole's. `has_alpha` says that the photo's own alpha channel is its mask; a `mask_path` takes its place. With
    `mask_below` that file is a depth map, and the object is where it is below this part of its whole range.
    `normal_path` is a picture of the true normals where the data set brings one (see `published_normals`).
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
        """Whether the view has a mask, of either kind."""
        return self.mask_path is not None or self.has_alpha


@dataclass(frozen=True, eq=False)
class Capture:
    """Photos with cameras in the run's frame: Z up, and the capture's own frame back through `to_capture`.

    `to_capture` is a 4×4 float64 similarity, p_capture = to_capture @ p_run: for NeRF-Blender the identity; elsewhere
    it puts the region of interest at the origin with radius 1. Where a direction was named that is up, turned about the origin after that.
    `points` (M, 3) are structure-from-motion points in the run's frame with `point_colors` (M, 3) sRGB-encoded in 0..1,
    both None where the layout has none. `centre` (3,) and `radius` are the region of interest: the object, or a room's
    foreground. `bounded` is a guess: the photos surround one object (True) or look at a place (False); `bounded_because` is
    its reason in words. Where only what is in a `box`, in the run's frame, is wanted, it moves nothing, but the region of interest
    lies in it then, and a ball of radius `reach` about `centre` holds what else the photos show; without one that is `radius`.
    `warnings` are lines about what was left out or looks wrong but does not stop the reading.
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
        """Whether every training view has a mask."""
        return all(view.masked for view in self.train_views)

    def fingerprint(self) -> str:
        """SHA-256 of the files' names and sizes and of the poses and intrinsics as they were read."""
        return self.digest
