"""Define captures and views: photos with their cameras, in the same form for every file layout."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from refgs.camera import Camera
from refgs.capture.box import Box
from refgs.capture.lens import Lens

Split = Literal["train", "test"]
Z_UP = ("nerf-blender", "tensoir")  # layouts in whose coordinates +Z is up, and whose masks are the photos' alpha


@dataclass(frozen=True, eq=False)
class View:
    """Photo and its camera.

    - `camera` is the pinhole camera of the undistorted photo at full size. Its name is the photo's file name without suffix; it is unique
      within a split.
    - `lens` is the lens model of the distorted photo file; None without distortion. `load_view` undistorts the photo.
    - `mask_path` is a mask file. Without one, `has_alpha` tells that the photo's own alpha channel is the mask.
    - `mask_below` is set if the mask file is a depth map. The object is where depth is below this fraction of the largest possible value.
    - `normal_path` is an image of the true normals, if the data set has them (see `published_normals`).
    - `prior_normals` and `prior_depth` are files of what another program guessed from a training photo (see `capture/priors.py`).
    """

    camera: Camera
    image_path: Path
    mask_path: Path | None
    split: Split
    lens: Lens | None = None
    has_alpha: bool = False
    mask_below: float | None = None
    normal_path: Path | None = None
    prior_normals: Path | None = None
    prior_depth: Path | None = None

    @property
    def masked(self) -> bool:
        """Tell whether the view has a mask: a mask file, or the photo's alpha channel."""
        return self.mask_path is not None or self.has_alpha


@dataclass(frozen=True, eq=False)
class Capture:
    """Photos with cameras, in the run's frame: the world coordinates used in training, with Z up.

    - `to_capture` is the 4×4 float64 similarity p_capture = to_capture @ p_run. It is the identity for most captures with a layout of
      Z_UP. Others are moved and scaled so that their region of interest has radius 1 about the origin. An up direction from the user
      rotates the run's frame.
    - `points` (M, 3) are from structure from motion, `point_colors` (M, 3) their sRGB colours in 0..1. Both are None if the capture has
      none.
    - `centre` (3,) and `radius` are the region of interest: a ball about the object, or about a room's foreground.
    - `bounded` is a guess: True if the photos surround one object, False if they show a room or an open scene. `bounded_because` says why.
    - `box` is the user's box around the part to reconstruct, or None. It makes the region of interest smaller.
    - `reach` is the radius of a ball about `centre` that contains the whole region of interest found without the box. It equals `radius` if
      there is no box.
    - `warnings` are lines of text about what was left out or looks wrong.
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
        """Return a SHA-256 hash of file names, file sizes, camera poses and intrinsics. It changes if the capture is changed."""
        return self.digest
