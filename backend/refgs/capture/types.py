"""Define captures and views: photos with their cameras, in the same form for every file layout."""

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from refgs.camera import Camera
from refgs.capture.box import Box
from refgs.capture.contents import changed_files, hash_files
from refgs.capture.lens import Lens
from refgs.errors import InputError

Split = Literal["train", "test"]
Z_UP = ("nerf-blender", "tensoir")  # layouts in whose coordinates +Z is up


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


class CaptureFiles(NamedTuple):
    """Hold what a capture's files say, in the capture's own coordinates (see `Capture`)."""

    folder: Path
    layout: str
    views: list[View]
    points: np.ndarray | None
    colors: np.ndarray | None
    warnings: list[str]


@dataclass(frozen=True, eq=False)
class Capture:
    """Photos with cameras, in the run's frame: the world coordinates of training, with Z up.

    - `to_capture` is the 4×4 float64 similarity p_capture = to_capture @ p_run. If the layout's coordinates have +Z up, it is the identity,
      unless the region of interest is too far away, too large or too small for float32. Other captures are rotated, moved and scaled: Z is
      then up, and the region of interest, found without a box, has radius 1 about the origin. If the user gives an up direction, the run's
      frame is rotated to it.
    - `points` (M, 3) are from structure from motion, `point_colors` (M, 3) their sRGB colours in 0..1. Both are None if the capture has
      none.
    - `centre` (3,) and `radius` are the region of interest: a ball about the object, or about a room's foreground.
    - `bounded` and `bounded_because` are the guess of `Region`: whether the photos are of one object, and why.
    - `box` is the user's box around the part to reconstruct, or None. It makes the region of interest smaller.
    - `reach` is the radius of a ball about `centre` that contains the whole region of interest found without the box. It equals `radius` if
      there is no box.
    - `digest` is a SHA-256 hash of file names, file sizes, camera poses and intrinsics.
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

    @cached_property
    def hashes(self) -> dict[str, str]:
        """Return the hashes of all files that a training reads, by relative path."""
        files = [(v.image_path, v.mask_path, v.prior_normals, v.prior_depth) for v in self.views]
        return hash_files(self.folder, [path for paths in files for path in paths if path is not None])

    def fingerprint(self) -> str:
        """Return a SHA-256 hash of `digest` and `hashes`. It changes if a camera, or the contents of a file, is changed.

        The files are read in the first call. Raises InputError naming the file that cannot be read.
        """
        return hashlib.sha256(json.dumps([self.digest, self.hashes], sort_keys=True).encode()).hexdigest()

    def check_unchanged(self, run: Path, known: str) -> None:
        """Raise InputError if this is not the capture that `run` was trained on, or if it has changed since.

        `run` is a run folder. `known` is the hash in its run.toml: a `fingerprint`, or in runs of earlier releases a `digest`, which
        depends on the sizes of files, not on their contents. The error names a changed file if the run folder has the hashes of files.
        """
        if known in (self.digest, self.fingerprint()):
            return
        if changed := changed_files(run, self.hashes):
            others = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
            what = f"{self.folder / changed[0]}{others} changed since {run} was trained on it"
            raise InputError(f"{what}: put back what was there, or train into a new folder")
        raise InputError(f"{self.folder} is not the capture that {run} was trained on, or it was changed since")
