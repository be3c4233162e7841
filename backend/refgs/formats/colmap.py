"""Read COLMAP's sparse models, binary or text (COLMAP's documentation, "Output Format").

COLMAP's own reader is not used. For a truncated file it prints an unrelated message, or asks for terabytes of memory. This reader raises
errors that name the file.
"""

import mmap
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from refgs.errors import InputError

T = TypeVar("T")

UNDISTORT = "Undistort the photos with COLMAP's image_undistorter and use its output."

# COLMAP's "Camera Models": number, name, parameters. Text files use the names.
MODELS = {
    0: ("SIMPLE_PINHOLE", "f cx cy"),
    1: ("PINHOLE", "fx fy cx cy"),
    2: ("SIMPLE_RADIAL", "f cx cy k"),
    3: ("RADIAL", "f cx cy k1 k2"),
    4: ("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    5: ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
    6: ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    7: ("FOV", "fx fy cx cy omega"),
    8: ("SIMPLE_RADIAL_FISHEYE", "f cx cy k"),
    9: ("RADIAL_FISHEYE", "f cx cy k1 k2"),
    10: ("THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3"),
    12: ("SIMPLE_DIVISION", "f cx cy k"),
    13: ("DIVISION", "fx fy cx cy k"),
    14: ("SIMPLE_FISHEYE", "f cx cy"),
    15: ("FISHEYE", "fx fy cx cy"),
    16: ("EUCM", "fx fy cx cy alpha beta"),
    17: ("EQUIRECTANGULAR", "w h"),
}
PARAMETERS = {name: tuple(parameters.split()) for name, parameters in MODELS.values()}
FARTHEST = 1e12  # largest coordinate: beyond it, float64 does not resolve an object of 1 unit well
LONGEST_NAME = 4096  # bytes of a photo's path
LARGEST_TEXT = 2 << 30  # bytes of a text file; a model of 1,000 photos has 200 MB


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

    Points with a value that is NaN, infinite or beyond FARTHEST are left out: no camera is there.
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
        with file.open("rb") as opened:  # mapped, not read: models of thousands of photos take gigabytes
            self.data, self.at = mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ), 0

    def take(self, layout: str) -> tuple:
        layout = "<" + layout
        values = struct.unpack_from(layout, self.data, self.at)
        self.at += struct.calcsize(layout)
        return values

    def name(self) -> str:
        end = self.data.find(b"\0", self.at, self.at + LONGEST_NAME)
        if end < 0:
            raise ValueError("truncated")
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
            raise InputError(f"{file}: camera model number {model} is not known. {UNDISTORT}")
        if number in cameras:
            raise ValueError("not COLMAP's")
        name = MODELS[model][0]
        cameras[number] = Intrinsics(name, width, height, source.take(f"{len(PARAMETERS[name])}d"))
    return cameras


def _binary_images(file: Path) -> list[Image]:
    source, images = _Reader(file), []
    for _ in range(source.take("Q")[0]):
        _, *pose, camera_id = source.take("I7di")
        if not any(pose[:4]):  # no rotation: a file of zeros has billions of these
            raise ValueError("not COLMAP's")
        images.append(Image(source.name(), camera_id, tuple(pose)))
        source.skip(24 * source.take("Q")[0])  # keypoints: x, y, point id
    return images


def _binary_points(file: Path) -> tuple[np.ndarray, np.ndarray]:
    source, rows, last = _Reader(file), [], None
    for _ in range(source.take("Q")[0]):
        number, *row = source.take("Q3d3Bd")[:7]
        if number == last:  # numbers are unique: a file of zeros has billions of these
            raise ValueError("not COLMAP's")
        last = number
        rows.append(row)
        source.skip(8 * source.take("Q")[0])  # track: image id, keypoint
    return _points(rows)


def _points(rows: list) -> tuple[np.ndarray, np.ndarray]:
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    table = table[(np.abs(table) <= FARTHEST).all(axis=1)]
    return table[:, :3], table[:, 3:] / 255.0


def _entries(file: Path, first: Callable[[str], bool] = lambda line: True) -> list[str]:
    """Return the lines of a COLMAP text file that begin an entry: those for which `first` is true. Comments and empty lines are left out.

    Raises ValueError if the file has fewer entries than its header says.
    """
    if file.stat().st_size > LARGEST_TEXT:
        raise ValueError("larger than such a file can be")
    lines = file.read_text(encoding="utf-8").splitlines()
    entries = [line for line in lines if line.strip() and not line.startswith("#") and first(line)]
    counted = next((match for line in lines if (match := re.match(r"# Number of \w+: (\d+)", line))), None)
    if counted and len(entries) < int(counted[1]):
        raise ValueError("fewer entries than counted")
    return entries


def _text_cameras(file: Path) -> dict[int, Intrinsics]:
    cameras = {}
    for line in _entries(file):
        number, model, width, height, *params = line.split()
        if len(params) != len(PARAMETERS.get(model, params)):
            raise ValueError("parameters missing")
        cameras[int(number)] = Intrinsics(model, int(width), int(height), tuple(map(float, params)))
    return cameras


def _text_images(file: Path) -> list[Image]:
    images = []
    for line in _entries(file, _is_image):
        _, *pose, camera_id, name = line.split(maxsplit=9)
        if len(pose) != 7:
            raise ValueError("numbers missing")
        images.append(Image(name.strip(), int(camera_id), tuple(map(float, pose))))
    return images


def _is_image(line: str) -> bool:
    """Return True for the line of an image, False for the line of its keypoints. Some programs leave the keypoints' line out.

    The line of an image ends in its name. The line of keypoints has triples of numbers. Raises ValueError for a line that is neither.
    """
    values = line.split()
    try:
        float(values[-1])
    except ValueError:
        return True
    if len(values) != 10 and len(values) % 3:
        raise ValueError("numbers missing")
    return len(values) == 10  # the image's name is a number


def _text_points(file: Path) -> tuple[np.ndarray, np.ndarray]:
    return _points([[float(value) for value in line.split()[1:7]] for line in _entries(file)])
