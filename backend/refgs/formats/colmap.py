"""Read COLMAP's sparse models, binary or text (COLMAP's documentation, "Output Format").

COLMAP's own reader is not used. For a truncated file it prints an unrelated message, or asks for terabytes of memory. This reader raises
errors that name the file.
"""

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from refgs.errors import InputError

T = TypeVar("T")

# COLMAP's "Camera Models": number, name, count of parameters. Text files use the names.
MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}
SUPPORTED = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")


@dataclass(frozen=True)
class Intrinsics:
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class Image:
    name: str
    camera_id: int
    pose: tuple[float, ...]  # qw qx qy qz tx ty tz, world to camera


def model_files(folder: Path) -> tuple[Path, Path, Path]:
    """Return the paths of a COLMAP model's cameras, images and points. The files may be missing.

    The names end in .bin if images.bin exists, otherwise in .txt.
    """
    suffix = ".bin" if (folder / "images.bin").is_file() else ".txt"
    cameras, images, points = (folder / f"{name}{suffix}" for name in ("cameras", "images", "points3D"))
    return cameras, images, points


def read_cameras(file: Path) -> dict[int, Intrinsics]:
    """Read a COLMAP model's cameras, keyed by camera id. Raises InputError for a broken file."""
    return _parse(file, _binary_cameras, _text_cameras)


def read_images(file: Path) -> list[Image]:
    """Read the names, camera ids and poses of a COLMAP model's images. Raises InputError for a broken file."""
    return _parse(file, _binary_images, _text_images)


def count_images(file: Path) -> int:
    """Count a COLMAP model's images, as `read_images` would read them. Raises InputError for a broken file."""
    return _parse(file, lambda file: _Reader(file).take("Q")[0], lambda file: len(_text_images(file)))


def read_points(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the points (M, 3) of a COLMAP model and their colours (M, 3), sRGB-encoded in 0..1. Raises InputError for a broken file.

    Points with a NaN or infinite value are left out.
    """
    return _parse(file, _binary_points, _text_points)


def _parse(file: Path, binary: Callable[[Path], T], text: Callable[[Path], T]) -> T:
    if not file.is_file():  # nor a device, which has no end
        raise InputError(f"{file}: there is no such file. Export the sparse model again.")
    try:
        return (binary if file.suffix == ".bin" else text)(file)
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}). Export the sparse model again.") from None
    except (struct.error, ValueError, IndexError, OverflowError) as error:
        raise InputError(f"{file}: the file is truncated or not COLMAP's. Export the sparse model again.") from error


class _Reader:
    """Read values from a binary file one after the other. Raises struct.error or ValueError if the file is truncated."""

    def __init__(self, file: Path):
        self.data, self.at = file.read_bytes(), 0

    def take(self, layout: str) -> tuple:
        layout = "<" + layout
        values = struct.unpack_from(layout, self.data, self.at)
        self.at += struct.calcsize(layout)
        return values

    def name(self) -> str:
        end = self.data.index(b"\0", self.at)
        text = self.data[self.at : end].decode("utf-8")
        self.at = end + 1
        return text

    def skip(self, count: int) -> None:
        self.at += count
        if self.at > len(self.data):
            raise ValueError("truncated")


def _binary_cameras(file: Path) -> dict[int, Intrinsics]:
    source, cameras = _Reader(file), {}
    for _ in range(source.take("Q")[0]):
        number, model, width, height = source.take("iiQQ")
        if model not in MODELS:
            raise InputError(f"{file}: camera model number {model} is not supported, only {', '.join(SUPPORTED)}.")
        name, count = MODELS[model]
        cameras[number] = Intrinsics(name, width, height, source.take(f"{count}d"))
    return cameras


def _binary_images(file: Path) -> list[Image]:
    source, images = _Reader(file), []
    for _ in range(source.take("Q")[0]):
        _, *pose, camera_id = source.take("I7di")
        images.append(Image(source.name(), camera_id, tuple(pose)))
        source.skip(24 * source.take("Q")[0])  # keypoints: x, y, point id
    return images


def _binary_points(file: Path) -> tuple[np.ndarray, np.ndarray]:
    source, rows = _Reader(file), []
    for _ in range(source.take("Q")[0]):
        rows.append(source.take("Q3d3Bd")[1:7])
        source.skip(8 * source.take("Q")[0])  # track: image id, keypoint
    return _points(rows)


def _points(rows: list) -> tuple[np.ndarray, np.ndarray]:
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    table = table[np.isfinite(table).all(axis=1)]
    return table[:, :3], table[:, 3:] / 255.0


def _entries(file: Path, images: bool = False) -> list[str]:
    """Return the lines of a COLMAP text file that are no comments, one an entry. Lines of images' keypoints are left out.

    Raises ValueError if the file has fewer entries than its header says.
    """
    lines = file.read_text(encoding="utf-8").splitlines()
    entries = [line for line in lines if line.strip() and not line.startswith("#")]
    if images:
        entries = [line for line in entries if not _is_keypoints(line)]
    counted = next((match for line in lines if (match := re.match(r"# Number of \w+: (\d+)", line))), None)
    if counted and len(entries) < int(counted[1]):
        raise ValueError("fewer entries than counted")
    return entries


def _is_keypoints(line: str) -> bool:
    """Tell a line of an image's keypoints, which are x, y and a point's id each, from a line of an image, which ends with its name."""
    words = line.split()
    try:
        [float(word) for word in words[-3:]]
    except ValueError:
        return False
    return len(words) % 3 == 0


def _text_cameras(file: Path) -> dict[int, Intrinsics]:
    cameras = {}
    for line in _entries(file):
        number, model, width, height, *params = line.split()
        if len(params) != dict(MODELS.values()).get(model, len(params)):
            raise ValueError("parameters missing")
        cameras[int(number)] = Intrinsics(model, int(width), int(height), tuple(map(float, params)))
    return cameras


def _text_images(file: Path) -> list[Image]:
    images = []
    for line in _entries(file, images=True):  # some programs leave out the keypoints' lines
        _, *pose, camera_id, name = line.split(maxsplit=9)
        if len(pose) != 7:
            raise ValueError("numbers missing")
        images.append(Image(name.strip(), int(camera_id), tuple(map(float, pose))))
    return images


def _text_points(file: Path) -> tuple[np.ndarray, np.ndarray]:
    return _points([[float(value) for value in line.split()[1:7]] for line in _entries(file)])
