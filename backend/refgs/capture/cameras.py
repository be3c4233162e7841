"""Read and write camera files: JSON for `refgs render --cameras`, and a run folder's cameras.json."""

import json
from pathlib import Path

import numpy as np

from refgs.camera import Camera
from refgs.capture.files import find_image
from refgs.capture.images import read_header
from refgs.capture.poses import OPENGL_TO_OPENCV, in_frame
from refgs.capture.transforms import frame_camera, read_frames
from refgs.capture.types import Capture
from refgs.errors import InputError
from refgs.paths import write_text


def read_cameras(file: Path) -> list[Camera]:
    """Read cameras from a NeRF-Blender or nerfstudio JSON file, in the capture's world coordinates.

    Each camera gets the name of its photo (`file_path`). If the file does not give the photo's size, it is read from the photo. A distorted
    camera is replaced by the pinhole camera of the undistorted photo. The file may also be cameras.json of a run folder: its cameras are
    transformed to the capture's coordinates. Raises InputError.
    """
    file = Path(file)
    shared, frames = read_frames(file)
    if not frames:
        raise InputError(f"{file}: there are no frames in it. Export the cameras again.")
    cameras = []
    for frame in frames:
        image = None if "w" in frame.values and "h" in frame.values else find_image(file.parent / frame.path)
        camera, lens = frame_camera(frame, read_header(image)[:2] if image else None)
        cameras.append(lens.pinhole(camera, frame.where) if lens else camera)
    if "to_capture" in shared:
        to_capture = _similarity(shared["to_capture"], file)
        cameras = [in_frame(camera, to_capture) for camera in cameras]
    return cameras


def write_cameras(
    file: Path,
    capture: Capture,
    light: str = "world",
    exposures: dict[str, list[float]] | None = None,
    refined: bool = False,
) -> None:
    """Write the run folder's cameras.json: the undistorted cameras in the run's frame, with OpenGL axes.

    `light` is "world" if the light stands still, or "camera" if it turns with the camera, as on a turntable. In the second case
    environment.exr shows the light at the first training photo, and the key `light_of` names that photo. `exposures` maps names of training
    photos to factors of red, green and blue: the scene's radiance times these factors gives the photo's. If the three are equal, one is
    written.
    `refined` tells that the training photos' poses were refined: a training view then has the key `refined`.
    """
    frames = []
    for view in capture.views:
        camera = view.camera
        known = exposures is not None and view.split == "train" and camera.name in exposures
        factors = exposures[camera.name] if known else []
        frame = {"exposure": factors if len(set(factors)) > 1 else factors[0]} if known else {}
        if refined and view.split == "train":
            frame["refined"] = True
        frames.append(
            frame
            | {
                "file_path": f"images/{camera.name}",
                "photo": _from(capture.folder, view.image_path).as_posix(),
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


def _from(folder: Path, file: Path) -> Path:
    return file.relative_to(folder) if file.is_relative_to(folder) else file


def read_run_cameras(file: Path) -> tuple[list[Camera], list[str], np.ndarray, list[float | list[float]], bool]:
    """Read a run folder's cameras.json.

    Return the cameras in the run's frame, the split of each ("train" or "test"), the similarity transform (4, 4) from the run's frame to
    the capture's, the exposure of each, and whether the training refined poses. An exposure is one factor, or one for each of red, green
    and blue (1 if the file has none).
    """
    file = Path(file)
    shared, frames = read_frames(file)
    cameras = [frame_camera(frame)[0] for frame in frames]
    return (
        cameras,
        [frame.values.get("split", "train") for frame in frames],
        _similarity(shared.get("to_capture"), file),
        [frame.values.get("exposure", 1.0) for frame in frames],
        any(frame.values.get("refined", False) for frame in frames),
    )


def _similarity(matrix: object, file: Path) -> np.ndarray:
    try:
        matrix = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or np.linalg.det(matrix[:3, :3]) <= 0:
        raise InputError(f'{file}: "to_capture" is not a similarity. Use the file that the training wrote.')
    return matrix
