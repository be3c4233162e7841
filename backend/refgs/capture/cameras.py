"""Read and write camera files: JSON for `refgs render --cameras`, and a run folder's cameras.json."""

import json
from pathlib import Path

import numpy as np

from refgs.camera import Camera
from refgs.capture.files import PHOTO_FOLDERS, Files
from refgs.capture.images import read_header
from refgs.capture.poses import OPENGL_TO_OPENCV, in_frame
from refgs.capture.transforms import frame_camera, where
from refgs.capture.types import Capture, View
from refgs.errors import InputError
from refgs.formats.transforms import read_run_transforms, read_transforms
from refgs.paths import write_text


def read_cameras(file: Path) -> list[Camera]:
    """Read cameras from a NeRF-Blender or nerfstudio JSON file, in the capture's world coordinates.

    Each camera gets the name of its photo (`file_path`). If the file does not give the photo's size, it is read from the photo. A distorted
    camera is replaced by the pinhole camera of the undistorted photo. The file may also be cameras.json of a run folder: its cameras are
    transformed to the capture's coordinates. Raises InputError.
    """
    file = Path(file)
    found = read_transforms(file)
    if not found.frames:
        raise InputError(f"{file}: there are no frames in it. Export the cameras again.")
    files, cameras = Files(file.parent), []
    for frame in found.frames:
        image = files.find(frame.path, *PHOTO_FOLDERS) if None in (frame.w, frame.h) else None
        camera, lens = frame_camera(frame, where(file, frame), read_header(image)[:2] if image else None)
        cameras.append(lens.pinhole(camera, where(file, frame)) if lens else camera)
    if found.to_capture is not None:
        to_capture = _similarity(found.to_capture, file)
        cameras = [in_frame(camera, to_capture) for camera in cameras]
    return cameras


def write_cameras(
    file: Path,
    capture: Capture,
    light: str = "world",
    exposures: dict[str, list[float]] | None = None,
    refined: bool = False,
) -> None:
    """Write the run folder's cameras.json: undistorted cameras with OpenGL axes, in the run's frame (the world coordinates of training).

    `light` is "world" if the light stands still, or "camera" if it turns with the camera, as on a turntable. In the second case the light
    in environment.exr is that of the first training photo, and the key `light_of` names that photo. `exposures` maps a training photo's
    name to three factors, for red, green and blue: the photo's radiance is the scene's times these factors. If the three are equal, only
    one is written. `refined` tells whether training refined the poses: each training view then has the key `refined`.
    """
    frames = []
    for view in capture.views:
        camera, mask = view.camera, _mask(view)
        factors = exposures.get(camera.name) if exposures is not None and view.split == "train" else None
        frame = {} if factors is None else {"exposure": factors if len(set(factors)) > 1 else factors[0]}
        if refined and view.split == "train":
            frame["refined"] = True
        frames.append(
            frame
            | {
                "file_path": f"images/{camera.name}",
                "photo": _from(capture.folder, view.image_path),
                **({} if mask is None else {"mask": _from(capture.folder, mask)}),
                "transform_matrix": (camera.camera_to_world @ OPENGL_TO_OPENCV).tolist(),
                "fl_x": camera.fx,
                "fl_y": camera.fy,
                "cx": camera.cx,
                "cy": camera.cy,
                "w": camera.width,
                "h": camera.height,
                "split": view.split,
            }
        )
    facts = {"frames": frames, "to_capture": capture.to_capture.tolist()}
    if light == "camera":
        facts["light_of"] = f"images/{capture.train_views[0].camera.name}"
    write_text(file, json.dumps(facts, indent=1))


def mask_names(folder: Path, views: list[View]) -> dict[str, str]:
    """Return the mask file of each photo that has one, by the photo's path. Paths are relative to the capture's `folder`, if in it."""
    return {_from(folder, v.image_path): _from(folder, mask) for v in views if (mask := _mask(v)) is not None}


def _mask(view: View) -> Path | None:
    return view.mask_path if view.mask_below is None else None  # not a depth map


def _from(folder: Path, file: Path) -> str:
    return (file.relative_to(folder) if file.is_relative_to(folder) else file.absolute()).as_posix()


def read_run_cameras(file: Path) -> tuple[list[Camera], list[str], np.ndarray, list[float | list[float]], bool]:
    """Read a run folder's cameras.json.

    Returns five values:

    - the cameras in the run's frame (the world coordinates of training)
    - the split of each camera, "train" or "test"
    - the similarity transform (4, 4) from the run's frame to the capture's coordinates
    - the exposure of each camera: one factor, or one for each of red, green and blue; 1 if the file gives none
    - whether training refined the poses

    Raises InputError.
    """
    file = Path(file)
    found = read_run_transforms(file)
    if not any(frame.split == "train" for frame in found.frames):
        raise InputError(f"{file}: there are no training frames in it. Use the file that the training wrote.")
    return (
        [frame_camera(frame, where(file, frame))[0] for frame in found.frames],
        [frame.split for frame in found.frames],
        _similarity(found.to_capture, file),
        [list(frame.exposure) if isinstance(frame.exposure, tuple) else frame.exposure for frame in found.frames],
        any(frame.refined for frame in found.frames),
    )


def _similarity(rows: list[list[float]], file: Path) -> np.ndarray:
    try:
        matrix = np.array(rows, dtype=np.float64)
    except ValueError:  # rows of different lengths
        matrix = np.empty(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or np.linalg.det(matrix[:3, :3]) <= 0:
        raise InputError(f'{file}: "to_capture" is not a similarity. Use the file that the training wrote.')
    return matrix
