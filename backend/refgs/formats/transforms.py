"""Describe the JSON format that NeRF-Blender, instant-ngp, nerfstudio and a run's cameras.json share: a list `frames` of cameras.

Intrinsics (`fl_x fl_y cx cy w h`, or `camera_angle_x` and `camera_angle_y` in radians) and the lens (`camera_model`, `is_fisheye`, and
coefficients such as `k1` and `p1`) are given for all frames at the file's top level, or in a frame. If both are given, the frame's value is
used. The format is documented in nerfstudio's "Data conventions" and instant-ngp's "Tips for training NeRF models". instant-ngp's keys
`scale` and `offset` are ignored: they only place the scene in its unit cube.
"""

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, model_validator

from refgs.formats.validate import Finite, Matrix, Model, Number, Vector, read_json

AGAIN = "Export the cameras again, or correct the file."
Positive = Annotated[Finite, Field(gt=0)]


class Intrinsics(Model):
    """Hold the intrinsics of a camera. Focal lengths, principal point and size are in pixels. A value that is not given is None."""

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
        """Return the file's other keys about the lens, with their values. A key counts if its name says so, such as `k1` or `lens_type`."""
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
    """Hold one camera. `transform_matrix` is its camera-to-world matrix with OpenGL's axes, (4, 4) or (3, 4).

    nerfstudio documents depth as millimetres, where 0 is unknown.
    """

    file_path: str
    transform_matrix: Matrix
    mask_path: str | None = None
    depth_file_path: str | None = None
    normal_file_path: str | None = None

    @property
    def path(self) -> str:
        """Return the photo's path as the file gives it, with forward slashes. It is relative to the file's folder."""
        return self.file_path.replace("\\", "/")

    @model_validator(mode="after")
    def _has_a_path(self) -> "Frame":
        if not self.file_path:
            raise ValueError("has an empty file_path")
        return self


class _Cameras(Model):
    """Hold the `frames` of a file. Intrinsics that the file gives once, for all frames, are copied into each frame."""

    @model_validator(mode="before")
    @classmethod
    def _share(cls, data: Any) -> Any:
        """Copy the intrinsics at the file's top level into each frame that does not give them itself."""
        if not isinstance(data, dict) or not isinstance(data.get("frames"), list):
            return data
        shared = {key: value for key, value in data.items() if key in Intrinsics.model_fields or _of_lens(key)}
        frames = [{**shared, **frame} if isinstance(frame, dict) else frame for frame in data["frames"]]
        return {**data, "frames": frames}


class Transforms(_Cameras):
    """Hold the cameras of a file, and three things that only some programs write. These are None if the file lacks them.

    They are the names of the training, test and validation photos, the path of a point cloud, and the matrix `to_capture`.
    """

    frames: list[Frame]
    train_filenames: list[str] | None = None
    test_filenames: list[str] | None = None
    val_filenames: list[str] | None = None
    ply_file_path: str | None = None
    to_capture: Matrix | None = None  # of a run's cameras.json: from the run's frame to the capture's


class RunFrame(Frame):
    """Hold a camera of a run. The photo's radiance is the scene's, times `exposure`: one number, or one each for red, green and blue."""

    split: Literal["train", "test"] = "train"
    exposure: Positive | Vector = 1.0
    refined: bool = False


class RunCameras(_Cameras):
    """Hold the cameras of a run, in the run's frame."""

    frames: list[RunFrame]
    to_capture: Matrix


class NovelFrame(Frame):
    """Hold a camera of Stanford-ORB's transforms_novel.json: its photo is in the folder `scene_name`."""

    scene_name: str


class NovelCameras(_Cameras):
    """Hold a transforms_novel.json of Stanford-ORB."""

    frames: list[NovelFrame]


def read_transforms(file: Path) -> Transforms:
    """Read a JSON file of cameras, whichever program wrote it. Raises InputError naming the file, the frame and the value that is wrong."""
    return read_json(file, Transforms, AGAIN)


def read_novel_transforms(file: Path) -> NovelCameras:
    """Read a transforms_novel.json. Raises InputError naming the file, the frame and the value that is wrong."""
    return read_json(file, NovelCameras, "Download the data set again.")


def read_run_transforms(file: Path) -> RunCameras:
    """Read a run's cameras.json. Raises InputError naming the file, the frame and the value that is wrong."""
    return read_json(file, RunCameras, "Use the file that the training wrote.")
