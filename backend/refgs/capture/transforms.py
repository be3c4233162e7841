"""Read cameras and photos from the JSON format that NeRF-Blender, instant-ngp and nerfstudio share (`refgs.formats.transforms`).

Poses are camera-to-world with OpenGL's axes.
"""

import math
from pathlib import Path

import numpy as np

from refgs.camera import Camera
from refgs.capture.files import PHOTO_FOLDERS, Files, leave_out_missing, photo_view, without_suffix
from refgs.capture.images import read_header
from refgs.capture.lens import Lens
from refgs.capture.mask_files import find_masks
from refgs.capture.poses import OPENGL_TO_OPENCV, world_to_camera
from refgs.capture.types import Split, View
from refgs.errors import InputError
from refgs.formats.transforms import Frame


def where(file: Path, frame: Frame) -> str:
    """Name a frame of a file for error messages."""
    return f"{file}, frame {frame.path}"


def frame_camera(frame: Frame, where: str, image_size: tuple[int, int] | None = None) -> tuple[Camera, Lens | None]:
    """Return the camera of a frame in the file's coordinates, and its lens model. The lens is None if the frame has no distortion.

    `image_size` (width, height) is used if the frame gives no size. Raises InputError, which begins with `where`, a name for the frame.
    """
    if frame.is_fisheye or (frame.camera_model or "").upper() in _NOT_PERSPECTIVE:
        raise InputError(f"{where}: the camera is not a perspective one. Undistort the photos to pinholes first.")
    width, height = frame.w, frame.h
    if width is None or height is None:
        if image_size is None:
            raise InputError(f"{where}: no image size. Add w and h (pixels) to the file.")
        width, height = image_size
    fx = _focal(frame.fl_x, frame.camera_angle_x, width)
    fy = _focal(frame.fl_y, frame.camera_angle_y, height)
    fx, fy = fy if fx is None else fx, fx if fy is None else fy
    if fx is None or fy is None:
        raise InputError(f"{where}: no focal length. Add fl_x (pixels) or camera_angle_x (radians) to the file.")
    cx, cy = width / 2 if frame.cx is None else frame.cx, height / 2 if frame.cy is None else frame.cy
    finite = all(math.isfinite(x) for x in (fx, fy, cx, cy, width, height))
    if not finite or min(fx, fy) <= 0 or round(min(width, height)) < 1:
        raise InputError(f"{where}: focal length or size is zero, negative or NaN. Correct the file.")
    pose = world_to_camera(_from_opengl(frame), where)
    camera = Camera(camera_name(frame.path), round(width), round(height), fx, fy, cx, cy, pose)
    k1, k2, k3, k4, p1, p2 = (value or 0.0 for value in (frame.k1, frame.k2, frame.k3, frame.k4, frame.p1, frame.p2))
    if not all(math.isfinite(x) for x in (k1, k2, k3, k4, p1, p2)):
        raise InputError(f"{where}: a distortion coefficient is NaN or infinite. Correct the file.")
    if not any((k1, k2, k3, k4, p1, p2)):
        return camera, None
    return camera, Lens(fx, fy, cx, cy, (k1, k2, k3, k4), (p1, p2))


def read_views(file: Path, frames: list[tuple[Frame, Split]]) -> tuple[list[View], list[str]]:
    """Make a view (a photo with its camera) of each frame whose photo is there. Return them, and warnings of what was left out.

    Cameras are in the file's coordinates; photo paths are relative to its folder. `frames` are pairs of a frame and its split, "train" or
    "test". Raises InputError.
    """
    files = Files(file.parent)
    named = [(pair, pair[0].path, files.find(pair[0].path, *PHOTO_FOLDERS)) for pair in frames]
    found, warnings = leave_out_missing(file, named)
    masks = find_masks(files, [image for (frame, _), image in found if not frame.mask_path])
    views = []
    for (frame, split), image in found:
        at = where(file, frame)
        mask = masks.get(image)
        if frame.mask_path and (mask := files.find(frame.mask_path, "masks")) is None:
            raise InputError(f"{at}: the mask {frame.mask_path} is missing. Put it back, or remove its mask_path.")
        camera = frame_camera(frame, at, read_header(image)[:2])
        views.append(photo_view(image, camera, split, mask, at))
    return views, warnings


def camera_name(path: str) -> str:
    """Return the name of a frame's camera: the last part of its `file_path`, without an image suffix."""
    return without_suffix(path.replace("\\", "/").rsplit("/", 1)[-1])


_NOT_PERSPECTIVE = {"OPENCV_FISHEYE", "FISHEYE", "FISHEYE624", "EQUIRECTANGULAR", "ORTHOPHOTO"}


def _focal(focal: float | None, angle: float | None, size: float) -> float | None:
    """Return a focal length in pixels, of itself or of the angle of view in radians over `size` pixels; None if neither is given."""
    if focal is not None or angle is None:
        return focal
    return size / 2 / math.tan(angle / 2) if 0 < angle < math.pi else math.nan


def _from_opengl(frame: Frame) -> np.ndarray | None:
    try:
        with np.errstate(invalid="ignore"):  # `world_to_camera` reports infinity
            return np.array(frame.transform_matrix, dtype=np.float64) @ OPENGL_TO_OPENCV
    except ValueError:  # rows of different lengths, or not of four
        return None
