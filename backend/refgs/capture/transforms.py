"""Read cameras and photos from the JSON format that NeRF-Blender, instant-ngp and nerfstudio share (`refgs.formats.transforms`).

Poses are camera-to-world with OpenGL's axes, or with those that the key `camera_convention` names.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from refgs.camera import Camera
from refgs.capture.files import PHOTO_FOLDERS, Files, leave_out_missing, photo_view, without_suffix
from refgs.capture.images import read_header
from refgs.capture.lens import BROWN, Lens, check_intrinsics
from refgs.capture.mask_files import find_masks
from refgs.capture.poses import OPENGL_TO_OPENCV, world_to_camera
from refgs.capture.priors import SUFFIXES
from refgs.capture.types import Split, View
from refgs.errors import InputError, one_line
from refgs.formats.colmap import PARAMETERS
from refgs.formats.transforms import Frame


def where(file: Path, frame: Frame) -> str:
    """Name a frame of a file for error messages."""
    return f"{file}, frame {frame.path}"


def frame_camera(frame: Frame, where: str, image_size: tuple[int, int] | None = None) -> tuple[Camera, Lens | None]:
    """Return the camera of a frame in the file's coordinates, and its lens model. The lens is None if the frame has no distortion.

    `image_size` (width, height) is used if the frame gives no size. Raises InputError, which begins with `where`, a name for the frame.
    """
    model, coefficients = _lens_model(frame, where)
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
    check_intrinsics((width, height), (fx, fy), (cx, cy), where, "Correct the file.")
    pose = world_to_camera(_camera_to_world(frame, where), where)
    camera = Camera(camera_name(frame.path), round(width), round(height), fx, fy, cx, cy, pose)
    lens = Lens(fx, fy, cx, cy, model, coefficients)
    return camera, lens if lens.distorts else None


# Models by `camera_model`, and the keys of their coefficients in COLMAP's order. nerfstudio has one model for all words of the first line.
_PERSPECTIVE = ("PERSPECTIVE", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_MODELS = {word: (BROWN, ("k1", "k2", "k3", "k4", "p1", "p2")) for word in _PERSPECTIVE} | {
    "FULL_OPENCV": ("FULL_OPENCV", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "SIMPLE_FISHEYE": ("FISHEYE", ()),
    "FISHEYE": ("FISHEYE", ()),
    "SIMPLE_RADIAL_FISHEYE": ("SIMPLE_RADIAL_FISHEYE", ("k1",)),
    "RADIAL_FISHEYE": ("RADIAL_FISHEYE", ("k1", "k2")),
    "OPENCV_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
    "THIN_PRISM_FISHEYE": ("THIN_PRISM_FISHEYE", PARAMETERS["THIN_PRISM_FISHEYE"][4:]),
    "RAD_TAN_THIN_PRISM_FISHEYE": ("RAD_TAN_THIN_PRISM_FISHEYE", PARAMETERS["RAD_TAN_THIN_PRISM_FISHEYE"][4:]),
    "FOV": ("FOV", ("omega",)),
}
_UNDISTORT = "Undistort the photos to pinholes, and export their cameras again."


def _lens_model(frame: Frame, where: str) -> tuple[str, tuple[float, ...]]:
    """Return a frame's lens model and its coefficients (see `Lens`). Raises InputError."""
    word = (frame.camera_model or ("OPENCV_FISHEYE" if frame.is_fisheye else "OPENCV")).upper()
    if word not in _MODELS:
        raise InputError(f"{where}: camera_model is {frame.camera_model}, which is not known. {_UNDISTORT}")
    if frame.is_fisheye and word in (*_PERSPECTIVE, "FULL_OPENCV"):
        raise InputError(f"{where}: is_fisheye is true, but camera_model is {frame.camera_model}. Correct the file.")
    model, keys = _MODELS[word]
    said = frame.lens_keys
    for key, value in said.items():
        if key not in keys and not _says_perspective(value):
            raise InputError(f"{where}: {key} is {str(value)[:60]}, which is not known of a lens {word}. {_UNDISTORT}")
    values = [0.0 if said.get(key) is None else said[key] for key in keys]
    for key, value in zip(keys, values, strict=True):
        if isinstance(value, bool) or not isinstance(value, float | int):
            raise InputError(f"{where}: {key} should be a valid number. Export the cameras again, or correct the file.")
        if not abs(value) <= _LARGEST:
            raise InputError(f"{where}: the distortion coefficient {key} is {str(value)[:20]}. Correct the file.")
    if keys and keys[0] in ("k0", "omega") and keys[0] not in said:  # other programs count from k1
        raise InputError(f"{where}: {keys[0]} is missing, a coefficient of {word}. Add it to the file.")
    return model, tuple(map(float, values))


_LARGEST = 1e9  # of a coefficient: those of r⁸ are large for long lenses


def _says_perspective(value: object) -> bool:
    """Tell whether a lens key's value is zero, empty, or a word for perspective."""
    if isinstance(value, str):
        return value.upper() in ("", "NONE", *_PERSPECTIVE)
    if isinstance(value, list | dict):
        return not any(value.values() if isinstance(value, dict) else value)
    return not value


def read_views(file: Path, frames: list[tuple[Frame, Split]]) -> tuple[list[View], list[str]]:
    """Make a view (a photo with its camera) of each frame whose photo is there. Return them, and warnings of what was left out.

    Cameras are in the file's coordinates; photo paths are relative to its folder. `frames` are pairs of a frame and its split, "train" or
    "test". A frame's files of depth and normals are priors (see `capture/priors.py`), which need not be there. Raises InputError.
    """
    files = Files(file.parent)
    named = [(pair, pair[0].path, files.find(pair[0].path, *PHOTO_FOLDERS)) for pair in frames]
    found, warnings = leave_out_missing(file, named)
    masks = find_masks(files, [image for (frame, _), image in found if not frame.mask_path])
    photos = {image for _, image in found}
    views, priors, absent = [], 0, []
    for (frame, split), image in found:
        at = where(file, frame)
        mask = masks.get(image)
        if frame.mask_path and (mask := files.find(frame.mask_path, "masks")) is None:
            raise InputError(f"{at}: the mask {frame.mask_path} is missing. Put it back, or remove its mask_path.")
        camera = frame_camera(frame, at, read_header(image)[:2])
        view = photo_view(image, camera, split, mask, at)
        for field, name in (("prior_depth", frame.depth_file_path), ("prior_normals", frame.normal_file_path)):
            if name:
                prior = files.find(name, suffixes=False)
                usable = prior is not None and prior not in photos and prior.suffix.lower() in SUFFIXES
                view, priors = replace(view, **{field: prior if usable else None}), priors + 1
                absent += [] if usable else [name]
        views.append(view)
    if absent:
        what = f"{len(absent)} of the {priors} files of depth or normals that {file.name} names"
        warnings.append(one_line(f"{what} are missing, or of a format that is not read: first {absent[0]}"))
    return views, warnings


def camera_name(path: str) -> str:
    """Return the camera's name: the last part of `path` without an image suffix."""
    return without_suffix(path.replace("\\", "/").rsplit("/", 1)[-1])


def _focal(focal: float | None, angle: float | None, size: float) -> float | None:
    """Return `focal`, or compute it in pixels from the angle in radians, NaN if wrong."""
    if focal is not None or angle is None:
        return focal
    return size / 2 / math.tan(angle / 2) if 0 < angle < math.pi else math.nan


_CONVENTIONS = {"opengl": OPENGL_TO_OPENCV, "blender": OPENGL_TO_OPENCV, "opencv": np.eye(4), "colmap": np.eye(4)}


def _camera_to_world(frame: Frame, where: str) -> np.ndarray | None:
    """Return a frame's camera-to-world matrix with OpenCV's axes, None if malformed. Raises InputError."""
    convention = frame.camera_convention or "opengl"
    if convention.lower() not in _CONVENTIONS:
        known = ", ".join(_CONVENTIONS)
        raise InputError(f"{where}: camera_convention is {convention}, which is not known, only {known}. Correct it.")
    try:
        with np.errstate(invalid="ignore"):  # `world_to_camera` reports infinity
            return np.array(frame.transform_matrix, dtype=np.float64) @ _CONVENTIONS[convention.lower()]
    except ValueError:  # rows of different lengths, or not of four
        return None
