"""Read COLMAP's sparse models, binary or text (COLMAP's documentation, "Output Format").

COLMAP's own reader is not used. For a truncated file it prints an unrelated message, or asks for terabytes of memory. This reader raises
errors that name the file.
"""

import os
import re
import struct
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, TypeVar

import numpy as np

from refgs.errors import InputError
from refgs.paths import LARGEST, open_file

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
    """Return the paths of a COLMAP model's cameras, images and points, existing or not."""
    suffix = ".bin" if (folder / "images.bin").is_file() else ".txt"
    cameras, images, points = (folder / f"{name}{suffix}" for name in ("cameras", "images", "points3D"))
    return cameras, images, points


def read_cameras(file: Path) -> dict[int, Intrinsics]:
    """Read a COLMAP model's cameras, keyed by camera id. Raises InputError for a broken file."""
    return _parse(file, _binary_cameras, _text_cameras)


def read_images(file: Path) -> list[Image]:
    """Read the images of a COLMAP model. Raises InputError for a broken file."""
    return _parse(file, _binary_images, _text_images)


def count_images(file: Path) -> int:
    """Return the number of images in a COLMAP model. Raises InputError for a broken file.

    The header of a binary file states the number, and nothing after the header is checked. The images in a text file are counted.
    """
    return _parse(file, _binary_count, lambda file: len(_text_images(file)))


def read_points(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the points (M, 3) of a COLMAP model and their colours (M, 3), sRGB-encoded in 0..1. Raises InputError for a broken file.

    Points are left out if a coordinate is NaN, infinite, or beyond ±FARTHEST.
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
    """Read consecutive values of a binary file. Raises struct.error or ValueError if truncated."""

    def __init__(self, file: BinaryIO):
        self._file, self._size = file, os.fstat(file.fileno()).st_size

    def take(self, layout: str) -> tuple:
        layout = "<" + layout
        return struct.unpack(layout, self._file.read(struct.calcsize(layout)))

    def name(self) -> str:
        letters = bytearray()
        while (letter := self._file.read(1)) != b"\0":
            letters += letter
            if not letter or len(letters) > LONGEST_NAME:
                raise ValueError("a name without an end")
        return letters.decode("utf-8")

    def skip(self, count: int) -> None:
        if self._file.tell() + count > self._size:
            raise ValueError("truncated")
        self._file.seek(count, 1)

    def rows(self, kind: str) -> Iterator[int]:
        """Read the number of rows, then yield the identifier of each row. `kind` is the identifier's format as in `struct`, such as "I".

        The caller must read the other values of a row before it asks for the next identifier. Raises ValueError if two consecutive rows
        have the same identifier. This finds files in which a part was never written, because such a part reads as zeros.
        """
        last = None
        for _ in range(self.take("Q")[0]):
            (number,) = self.take(kind)
            if number == last:
                raise ValueError("one identifier twice")
            last = number
            yield number


def _binary_count(file: Path) -> int:
    with open_file(file) as opened:
        return _Reader(opened).take("Q")[0]


def _binary_cameras(file: Path) -> dict[int, Intrinsics]:
    with open_file(file) as opened:
        return dict(_each_camera(file, _Reader(opened)))


def _each_camera(file: Path, source: _Reader) -> Iterator[tuple[int, Intrinsics]]:
    for number in source.rows("i"):
        model, width, height = source.take("iQQ")
        if model not in MODELS:
            raise InputError(f"{file}: camera model number {model} is not known. {UNDISTORT}")
        name = MODELS[model][0]
        yield number, Intrinsics(name, width, height, source.take(f"{len(PARAMETERS[name])}d"))


def _binary_images(file: Path) -> list[Image]:
    images = []
    with open_file(file) as opened:
        source = _Reader(opened)
        for _ in source.rows("I"):
            *pose, camera_id = source.take("7di")
            images.append(Image(source.name(), camera_id, tuple(pose)))
            source.skip(24 * source.take("Q")[0])  # keypoints: x, y, point id
    return images


def _binary_points(file: Path) -> tuple[np.ndarray, np.ndarray]:
    numbers = array("d")  # a list takes five times as much memory
    with open_file(file) as opened:
        source = _Reader(opened)
        for _ in source.rows("Q"):
            numbers.extend(source.take("3d3Bd")[:6])
            source.skip(8 * source.take("Q")[0])  # track: image id, keypoint
    return _points(numbers)


def _points(numbers: array) -> tuple[np.ndarray, np.ndarray]:
    table = np.array(numbers).reshape(-1, 6)
    table = table[(np.abs(table) <= FARTHEST).all(axis=1)]
    return table[:, :3], table[:, 3:] / 255.0


def _entries(file: Path, first: Callable[[str], bool] = lambda line: True) -> list[str]:
    """Return the lines of a COLMAP text file that `first` accepts. Raises ValueError."""
    entries, counted = [], None
    with open_file(file) as opened:
        while data := opened.readline(LARGEST):
            if len(data) == LARGEST:
                raise ValueError("a line without an end")
            line = data.decode("utf-8").rstrip("\r\n")
            if line.startswith("#"):
                counted = counted or re.match(r"# Number of \w+: (\d+)", line)
            elif line.strip() and first(line):
                entries.append(line)
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
    """Tell whether a line of images.txt is an image, not keypoints. Raises ValueError."""
    # An image's line ends in the image's name. A list of keypoints has three numbers for each.
    values = line.split()
    try:
        float(values[-1])
    except ValueError:
        return True
    if len(values) != 10 and len(values) % 3:
        raise ValueError("numbers missing")
    return len(values) == 10  # the image's name is a number


def _text_points(file: Path) -> tuple[np.ndarray, np.ndarray]:
    numbers = array("d")
    for line in _entries(file):
        row = [float(value) for value in line.split()[1:7]]
        if len(row) < 6:
            raise ValueError("numbers missing")
        numbers.extend(row)
    return _points(numbers)
