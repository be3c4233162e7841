"""Describe the JSON format that NeRF-Blender, instant-ngp, nerfstudio and a run's cameras.json share: a list `frames` of cameras.

Intrinsics (`fl_x fl_y cx cy w h`, or `camera_angle_x` and `camera_angle_y` in radians) and distortion (`k1 k2 k3 k4 p1 p2`) are given for
all frames at the file's top level, or in a frame. If both are given, the frame's value is used. The format is documented in nerfstudio's
"Data conventions" and instant-ngp's "Tips for training NeRF models". instant-ngp's keys `scale` and `offset` are ignored: they only place
the scene in its unit cube.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from refgs.formats.validate import Finite, Matrix, Model, Number, Vector, read_json

AGAIN = "Export the cameras again, or correct the file."
Positive = Annotated[Finite, Field(gt=0)]


class Intrinsics(Model):
    """Hold the intrinsics of a camera. Focal lengths, principal point and size are in pixels. A value that is not given is None."""

    fl_x: Number | None = None
    fl_y: Number | None = None
    camera_angle_x: Number | None = None
    camera_angle_y: Number | None = None
    cx: Number | None = None
    cy: Number | None = None
    w: Number | None = None
    h: Number | None = None
    k1: Number | None = None
    k2: Number | None = None
    k3: Number | None = None
    k4: Number | None = None
    p1: Number | None = None
    p2: Number | None = None
    camera_model: str | None = None
    is_fisheye: bool | None = None


class Frame(Intrinsics):
    """Hold one camera. `transform_matrix` is its camera-to-world matrix with OpenGL's axes, (4, 4) or (3, 4)."""

    file_path: str
    transform_matrix: Matrix
    mask_path: str | None = None

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
    """Hold the `frames` of a file. Values that all frames share are in each frame."""

    @model_validator(mode="before")
    @classmethod
    def _share(cls, data: Any) -> Any:
        """Complete each frame by the intrinsics at the file's top level."""
        if not isinstance(data, dict) or not isinstance(data.get("frames"), list):
            return data
        shared = {key: data[key] for key in Intrinsics.model_fields if key in data}
        frames = [{**shared, **frame} if isinstance(frame, dict) else frame for frame in data["frames"]]
        return {**data, "frames": frames}


class Transforms(_Cameras):
    """Hold the cameras of a file, and what nerfstudio and instant-ngp say besides."""

    frames: list[Frame]
    train_filenames: list[str] | None = None
    test_filenames: list[str] | None = None
    val_filenames: list[str] | None = None
    ply_file_path: str | None = None
    to_capture: Matrix | None = None  # of a run's cameras.json: from the run's frame to the capture's


class RunFrame(Frame):
    """Hold a camera of a run. The scene's radiance times `exposure`, one factor or one each for red, green and blue, gives the photo's."""

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
    """Read cameras from a JSON file of this format. Raises InputError naming the file, the frame and the value that is wrong."""
    return read_json(file, Transforms, AGAIN)


def read_novel_transforms(file: Path) -> NovelCameras:
    """Read a transforms_novel.json. Raises InputError naming the file, the frame and the value that is wrong."""
    return read_json(file, NovelCameras, "Download the data set again.")


def read_run_transforms(file: Path) -> RunCameras:
    """Read a run's cameras.json. Raises InputError naming the file, the frame and the value that is wrong."""
    return read_json(file, RunCameras, "Use the file that the training wrote.")
