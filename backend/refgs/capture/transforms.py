"""Read the JSON format that NeRF-Blender, instant-ngp and nerfstudio share: a list `frames`, each with a `transform_matrix`.

Poses are camera-to-world with OpenGL's axes. Intrinsics (`fl_x fl_y cx cy w h`, or `camera_angle_x` and `camera_angle_y` in radians) and
distortion (`k1 k2 k3 k4 p1 p2`) are given for all frames at the file's top level, or in a frame. If both are given, the frame's value is
used. The format is documented in nerfstudio's "Data conventions" and instant-ngp's "Tips for training NeRF models". instant-ngp's keys
`aabb_scale`, `scale` and `offset` are ignored: they only place the scene in its unit cube.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from refgs.camera import Camera
from refgs.capture.files import IMAGE_SUFFIXES, Masks, find_image, photo_view, report_missing
from refgs.capture.images import read_header
from refgs.capture.lens import Lens
from refgs.capture.poses import OPENGL_TO_OPENCV, world_to_camera
from refgs.capture.types import Split, View
from refgs.errors import InputError


@dataclass(frozen=True)
class Frame:
    """One camera of a transforms JSON: an entry of its list `frames`.

    `values` are the entry's keys and values. Keys that the entry lacks are taken from the file's top level.
    """

    values: dict
    file: Path

    @property
    def path(self) -> str:
        """Return the photo's path as the file gives it, with forward slashes. It is relative to the file's folder."""
        return str(self.values["file_path"]).replace("\\", "/")

    @property
    def where(self) -> str:
        return f"{self.file}, frame {self.path}"

    def number(self, key: str) -> float | None:
        """Return the number stored under a key, None if it is absent. Raises InputError if the value is not a number."""
        value = self.values.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"{self.where}: {key} is not a number. Correct the file.")
        return float(value)


def read_json(file: Path) -> object:
    """Read a JSON file. Raises InputError naming the file if it is missing or not JSON."""
    try:
        return json.loads(file.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise InputError(f"{file}: there is no such file. Name a transforms JSON.") from None
    except json.JSONDecodeError as error:
        raise InputError(f"{file}: not JSON: line {error.lineno}: {error.msg}. Export the file again.") from error
    except (UnicodeDecodeError, OSError) as error:
        raise InputError(f"{file}: cannot be read as text ({error}). Export the file again.") from error


def read_frames(file: Path) -> tuple[dict, list[Frame]]:
    """Read a transforms JSON. Return its top-level keys and values as a dict, and its frames. Raises InputError for another format."""
    data = read_json(file)
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list):
        raise InputError(f'{file}: there is no list "frames" in it. Export the cameras again.')
    shared = {key: value for key, value in data.items() if key != "frames"}
    for number, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str) or not frame["file_path"]:
            raise InputError(f"{file}: frame {number} has no file_path. Export the cameras again.")
    return shared, [Frame({**shared, **frame}, file) for frame in frames]


def frame_camera(frame: Frame, image_size: tuple[int, int] | None = None) -> tuple[Camera, Lens | None]:
    """Return the camera of a frame in the file's coordinates, and its lens model. The lens is None if the frame has no distortion.

    `image_size` (width, height) is used if the frame gives no size. Raises InputError naming the frame.
    """
    if frame.values.get("is_fisheye") or str(frame.values.get("camera_model", "")).upper() in _NOT_PERSPECTIVE:
        raise InputError(f"{frame.where}: the camera is not a perspective one. Undistort the photos to pinholes first.")
    width, height = frame.number("w"), frame.number("h")
    if width is None or height is None:
        if image_size is None:
            raise InputError(f"{frame.where}: no image size. Add w and h (pixels) to the file.")
        width, height = image_size
    fx = _focal(frame, "fl_x", "camera_angle_x", width)
    fy = _focal(frame, "fl_y", "camera_angle_y", height)
    fx, fy = fy if fx is None else fx, fx if fy is None else fy
    if fx is None:
        raise InputError(f"{frame.where}: no focal length. Add fl_x (pixels) or camera_angle_x (radians) to the file.")
    cx, cy = frame.number("cx"), frame.number("cy")
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    if not all(math.isfinite(x) for x in (fx, fy, cx, cy, width, height)) or min(fx, fy, width, height) <= 0:
        raise InputError(f"{frame.where}: focal length or size is zero, negative or NaN. Correct the file.")
    pose = world_to_camera(_from_opengl(frame), frame.where)
    camera = Camera(camera_name(frame.path), round(width), round(height), fx, fy, cx, cy, pose)
    k1, k2, k3, k4, p1, p2 = (frame.number(key) or 0.0 for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if not all(math.isfinite(x) for x in (k1, k2, k3, k4, p1, p2)):
        raise InputError(f"{frame.where}: a distortion coefficient is NaN or infinite. Correct the file.")
    if not any((k1, k2, k3, k4, p1, p2)):
        return camera, None
    return camera, Lens(fx, fy, cx, cy, (k1, k2, k3, k4), (p1, p2))


def read_views(file: Path, frames: list[tuple[Frame, Split]]) -> list[View]:
    """Make a view (a photo with its camera) of each frame. Cameras are in the file's coordinates; photo paths are relative to its folder.

    `frames` are pairs of a frame and its split, "train" or "test". Raises InputError.
    """
    folder = file.parent
    found = [(frame, split, find_image(folder / frame.path)) for frame, split in frames]
    report_missing(file, [frame.path for frame, _, path in found if path is None], len(found))
    masks = Masks(folder)
    views = []
    for frame, split, image in found:
        mask = masks.find(image, frame.values.get("mask_path"), frame.where)
        camera = frame_camera(frame, read_header(image)[:2])
        views.append(photo_view(image, camera, split, mask, frame.where))
    return views


def camera_name(path: str) -> str:
    """Return the name of a frame's camera: the last part of its `file_path`, without an image suffix."""
    name = path.replace("\\", "/").rsplit("/", 1)[-1]
    stem, dot, suffix = name.rpartition(".")
    return stem if dot and f".{suffix.lower()}" in IMAGE_SUFFIXES else name


_NOT_PERSPECTIVE = {"OPENCV_FISHEYE", "FISHEYE", "FISHEYE624", "EQUIRECTANGULAR", "ORTHOPHOTO"}


def _focal(frame: Frame, focal: str, angle: str, size: float) -> float | None:
    value = frame.number(focal)
    if value is not None:
        return value
    radians = frame.number(angle)
    if radians is None:
        return None
    return size / 2 / math.tan(radians / 2) if 0 < radians < math.pi else math.nan


def _from_opengl(frame: Frame) -> object:
    try:
        with np.errstate(invalid="ignore"):  # `world_to_camera` reports infinity
            return np.array(frame.values.get("transform_matrix"), dtype=np.float64) @ OPENGL_TO_OPENCV
    except (TypeError, ValueError):
        return None
