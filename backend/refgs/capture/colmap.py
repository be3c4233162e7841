"""Read COLMAP captures: a sparse model in `sparse/0` or `sparse`, binary or text, with photos in `images` or beside it.

Ref-NeRF's real scenes and mip-NeRF 360's also have reduced photos in `images_2`, `images_4` and `images_8`. Naming such a folder
uses its photos; their suffix may differ from that in the model.

COLMAP's documentation describes the files under "Output Format". COLMAP's own reader answers a truncated file with an unrelated
message, or asks for terabytes of memory; this one names the file.
"""

import re
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from refgs.camera import Camera
from refgs.capture.files import Masks, find_image, photo_view, report_missing
from refgs.capture.lens import Lens
from refgs.capture.poses import world_to_camera
from refgs.capture.transforms import camera_name
from refgs.capture.types import View
from refgs.errors import InputError

# COLMAP's "Camera Models" by number: name and count of parameters. Text files use the names.
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
class _Intrinsics:
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class _Image:
    name: str
    camera_id: int
    pose: tuple[float, ...]  # qw qx qy qz tx ty tz, world to camera


def find_model(folder: Path) -> tuple[Path, Path] | None:
    """Return the folders of a capture's photos and of its sparse model; None without a model.

    `folder` is the capture's, or one with its reduced photos.
    """
    reduced = re.fullmatch(r"images_\d+", folder.name)
    root, photos = (folder.parent, folder) if reduced else (folder, folder / "images")
    if not photos.is_dir():
        photos = folder
    candidates = (root / "sparse" / "0", root / "sparse")
    names = ("cameras.bin", "cameras.txt", "images.bin", "images.txt")
    model = next((path for path in candidates if any((path / name).is_file() for name in names)), None)
    return None if model is None else (photos, model)


def read_colmap(photos: Path, model: Path) -> tuple[list[View], np.ndarray | None, np.ndarray | None]:
    """Read the views, points (M, 3) and their colours (M, 3) in 0..1, in the model's frame. Raises InputError."""
    suffix = ".bin" if (model / "images.bin").is_file() else ".txt"
    cameras_file, images_file, points_file = (model / f"{name}{suffix}" for name in ("cameras", "images", "points3D"))
    for file in (cameras_file, images_file):
        if not file.is_file():
            raise InputError(f"{file}: the file is missing. Export the sparse model again.")
    readers = _BINARY if suffix == ".bin" else _TEXT
    cameras = _parse(cameras_file, readers[0])
    images = sorted(_parse(images_file, readers[1]), key=lambda image: image.name)
    points, colors = _parse(points_file, readers[2]) if points_file.is_file() else (None, None)

    found = [(image, find_image(photos / image.name, any_suffix=True)) for image in images]
    report_missing(images_file, [f"{photos.name}/{i.name}" for i, path in found if path is None], len(found))
    masks = Masks(photos if (photos / "sparse").is_dir() else photos.parent)
    views = []
    for image, path in found:
        where = f"{images_file}, image {image.name}"
        if image.camera_id not in cameras:
            raise InputError(f"{where}: its camera {image.camera_id} is not in {cameras_file.name}. Export it again.")
        mask = masks.find(path, None, where)
        views.append(photo_view(path, _camera(image, cameras[image.camera_id], where), "train", mask, where))
    return views, points, colors


def _camera(image: _Image, intrinsics: _Intrinsics, where: str) -> tuple[Camera, Lens | None]:
    if intrinsics.model not in SUPPORTED:
        raise InputError(
            f"{where}: COLMAP's camera model {intrinsics.model} is not supported, only {', '.join(SUPPORTED)}. "
            "Undistort the photos with COLMAP's image_undistorter and use its output."
        )
    radial, tangential = (0.0, 0.0, 0.0, 0.0), (0.0, 0.0)
    match intrinsics.model, intrinsics.params:
        case "SIMPLE_PINHOLE", (f, cx, cy):
            fx = fy = f
        case "PINHOLE", (fx, fy, cx, cy):
            pass
        case "SIMPLE_RADIAL", (f, cx, cy, k1):
            fx, fy, radial = f, f, (k1, 0.0, 0.0, 0.0)
        case "RADIAL", (f, cx, cy, k1, k2):
            fx, fy, radial = f, f, (k1, k2, 0.0, 0.0)
        case "OPENCV", (fx, fy, cx, cy, k1, k2, p1, p2):
            radial, tangential = (k1, k2, 0.0, 0.0), (p1, p2)
    if not np.isfinite(intrinsics.params).all() or min(fx, fy, intrinsics.width, intrinsics.height) <= 0:
        raise InputError(f"{where}: focal length or size is zero, negative or NaN. Export the sparse model again.")
    qw, qx, qy, qz, *translation = image.pose
    rotation = _rotation(np.array([qw, qx, qy, qz]))
    # Via camera-to-world, because `world_to_camera` checks poses.
    camera_to_world = np.column_stack([rotation.T, -rotation.T @ translation])
    pose = world_to_camera(camera_to_world, where)
    name = camera_name(image.name)
    camera = Camera(name, intrinsics.width, intrinsics.height, fx, fy, cx, cy, pose)
    return camera, Lens(fx, fy, cx, cy, radial, tangential) if any(radial + tangential) else None


def _rotation(q: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of a quaternion wxyz, which need not be normalised. A zero one gives NaN."""
    with np.errstate(invalid="ignore"):
        w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _parse(file: Path, parser):
    try:
        return parser(file)
    except (struct.error, ValueError, IndexError, OverflowError) as error:
        raise InputError(f"{file}: the file is truncated or not COLMAP's. Export the sparse model again.") from error


class _Bytes:
    """Read a binary file from front to back. Raises struct.error if it is truncated."""

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


def _binary_cameras(file: Path) -> dict[int, _Intrinsics]:
    source, cameras = _Bytes(file), {}
    for _ in range(source.take("Q")[0]):
        number, model, width, height = source.take("iiQQ")
        if model not in MODELS:
            raise InputError(f"{file}: camera model number {model} is not supported, only {', '.join(SUPPORTED)}.")
        name, count = MODELS[model]
        cameras[number] = _Intrinsics(name, width, height, source.take(f"{count}d"))
    return cameras


def _binary_images(file: Path) -> list[_Image]:
    source, images = _Bytes(file), []
    for _ in range(source.take("Q")[0]):
        _, *pose, camera_id = source.take("I7di")
        images.append(_Image(source.name(), camera_id, tuple(pose)))
        source.skip(24 * source.take("Q")[0])  # keypoints: x, y, point id
    return images


def _binary_points(file: Path) -> tuple[np.ndarray, np.ndarray]:
    source, rows = _Bytes(file), []
    for _ in range(source.take("Q")[0]):
        rows.append(source.take("Q3d3Bd")[1:7])
        source.skip(8 * source.take("Q")[0])  # track: image id, keypoint
    return _points(rows)


def _points(rows: list) -> tuple[np.ndarray, np.ndarray]:
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    table = table[np.isfinite(table).all(axis=1)]
    return table[:, :3], table[:, 3:] / 255.0


def _entries(file: Path, lines_each: int = 1) -> list[str]:
    """Return the first line of each entry. Raises ValueError if there are fewer than the file's header counts."""
    lines = file.read_text(encoding="utf-8").splitlines()
    entries = [line for line in lines if not line.startswith("#") and (lines_each > 1 or line.strip())]
    while entries and not entries[-1].strip():  # an image's line of keypoints may be empty
        entries.pop()
    entries = entries[::lines_each]
    counted = next((match for line in lines if (match := re.match(r"# Number of \w+: (\d+)", line))), None)
    if counted and len(entries) < int(counted[1]):
        raise ValueError("fewer entries than counted")
    return entries


def _text_cameras(file: Path) -> dict[int, _Intrinsics]:
    cameras = {}
    for line in _entries(file):
        number, model, width, height, *params = line.split()
        if len(params) != dict(MODELS.values()).get(model, len(params)):
            raise ValueError("parameters missing")
        cameras[int(number)] = _Intrinsics(model, int(width), int(height), tuple(map(float, params)))
    return cameras


def _text_images(file: Path) -> list[_Image]:
    images = []
    for line in _entries(file, lines_each=2):  # the second line holds keypoints
        _, *pose, camera_id, name = line.split(maxsplit=9)
        images.append(_Image(name.strip(), int(camera_id), tuple(map(float, pose))))
    return images


def _text_points(file: Path) -> tuple[np.ndarray, np.ndarray]:
    return _points([[float(value) for value in line.split()[1:7]] for line in _entries(file)])


_BINARY = (_binary_cameras, _binary_images, _binary_points)
_TEXT = (_text_cameras, _text_images, _text_points)
