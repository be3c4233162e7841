"""Describe the JSON format that NeRF-Blender, instant-ngp, nerfstudio and a run's cameras.json share: a list `frames` of cameras.

Intrinsics (`fl_x fl_y cx cy w h`, or `camera_angle_x` and `camera_angle_y` in radians) and the lens (`camera_model`, `is_fisheye`, and
coefficients such as `k1` and `p1`) are given for all frames at the file's top level, or in a frame. If both are given, the frame's value is
used. The format is documented in nerfstudio's "Data conventions" and instant-ngp's "Tips for training NeRF models". The keys `scale` and
`offset` are ignored: they only place the scene in the unit cube of instant-ngp.
"""

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, model_validator

from refgs.formats.validate import Finite, Matrix, Model, Number, Vector, read_json

AGAIN = "Export the cameras again, or correct the file."
Positive = Annotated[Finite, Field(gt=0)]


class Intrinsics(Model):
    """Hold a camera's intrinsics, in pixels and radians; None means not given."""

    model_config = ConfigDict(extra="allow")

    fl_x: Number | None = None
    fl_y: Number | None = None
    camera_angle_x: Number | None = None
    camera_angle_y: Number | None = None
    cx: Number | None = None
    cy: Number | None = None
    w: Number | None = None
    h: Number | None = None
    camera_model: str | None = None
    is_fisheye: bool | None = None
    camera_convention: str | None = None

    @property
    def lens_keys(self) -> dict[str, Any]:
        """Return the lens keys that are no fields, such as `k1`, with their values."""
        return {key: value for key, value in (self.model_extra or {}).items() if _of_lens(key)}


# Distortion coefficients of any program, and keys of other projections than the perspective. "undistorted" is no such key.
_LENS_KEYS = re.compile(
    r"(k|p|s|b|sx|sy|tx|ty|tau|xi|radial|tangential|ftheta_?p)_?\d+|t[12]|omega|xi|skew"
    r"|(camera|cam|lens|distortion)_?(type|projection)|(cam|distortion)_?model|projection(_?(type|model))?"
    r"|(?!undistort).*(distort|fisheye|f_?theta|lat_?long|equirect|ortho(graph|photo)|spheric|panoram|omnidirect|cylindr).*",
    re.IGNORECASE,
)


def _of_lens(key: str) -> bool:
    return _LENS_KEYS.fullmatch(key) is not None


class Frame(Intrinsics):
    """Hold one camera; `camera_convention`, or else OpenGL, names the axes of its camera-to-world matrix.

    nerfstudio documents depth as millimetres, where 0 is unknown.
    """

    file_path: str
    transform_matrix: Matrix
    mask_path: str | None = None
    depth_file_path: str | None = None
    normal_file_path: str | None = None

    @property
    def path(self) -> str:
        """Return the photo's path relative to the camera file's folder, with forward slashes."""
        return self.file_path.replace("\\", "/")

    @model_validator(mode="after")
    def _has_a_path(self) -> "Frame":
        if not self.file_path:
            raise ValueError("has an empty file_path")
        return self


class _Cameras(Model):
    """Hold a file's `frames`, each with the intrinsics that the file shares."""

    @model_validator(mode="before")
    @classmethod
    def _share(cls, data: Any) -> Any:
        """Copy the file's intrinsics into each frame that does not give its own."""
        if not isinstance(data, dict) or not isinstance(data.get("frames"), list):
            return data
        shared = {key: value for key, value in data.items() if key in Intrinsics.model_fields or _of_lens(key)}
        frames = [{**shared, **frame} if isinstance(frame, dict) else frame for frame in data["frames"]]
        return {**data, "frames": frames}


class Transforms(_Cameras):
    """Hold the cameras of a file, and values that only some programs write. Such a value is None if the file lacks it.

    - `train_filenames`, `test_filenames`, `val_filenames`: the names of the training, test and validation photos
    - `ply_file_path`: the path of a point cloud
    - `to_capture`: the matrix (4, 4) from a run's coordinates to its capture's coordinates
    """

    frames: list[Frame]
    train_filenames: list[str] | None = None
    test_filenames: list[str] | None = None
    val_filenames: list[str] | None = None
    ply_file_path: str | None = None
    to_capture: Matrix | None = None  # of a run's cameras.json: from the run's frame to the capture's


class RunFrame(Frame):
    """Hold a camera in a run's cameras.json.

    - `split`: "train", or "test" for a held-out view
    - `exposure`: the photo's radiance divided by the scene's: one number, or three numbers for red, green and blue
    - `refined`: true if the training refined the camera's pose
    """

    split: Literal["train", "test"] = "train"
    exposure: Positive | Vector = 1.0
    refined: bool = False


class RunCameras(_Cameras):
    """Hold a run's cameras in its coordinates; `to_capture` is the matrix to the capture's."""

    frames: list[RunFrame]
    to_capture: Matrix


class NovelFrame(Frame):
    """Hold a Stanford-ORB camera whose photo shows the object in the scene `scene_name`."""

    scene_name: str


class NovelCameras(_Cameras):
    """Hold Stanford-ORB's transforms_novel.json: the cameras of photos that show the same object in other scenes."""

    frames: list[NovelFrame]


def read_transforms(file: Path) -> Transforms:
    """Read a JSON file of cameras from any program. Raises InputError."""
    return read_json(file, Transforms, AGAIN)


def read_novel_transforms(file: Path) -> NovelCameras:
    """Read Stanford-ORB's transforms_novel.json. Raises InputError."""
    return read_json(file, NovelCameras, "Download the data set again.")


def read_run_transforms(file: Path) -> RunCameras:
    """Read a run's cameras.json. Raises InputError."""
    return read_json(file, RunCameras, "Use the file that the training wrote.")
