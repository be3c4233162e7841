"""Read COLMAP captures: a sparse model in `sparse/0` or `sparse`, binary or text, with photos in `images` or in the capture's folder.

Some data sets, such as the real scenes of Ref-NeRF and mip-NeRF 360, also have reduced photos in `images_2`, `images_4` and `images_8`. To
use them, pass the path of such a folder as the capture's. Reduced photos may have another file suffix than the photos that the model names.
"""

import re
from pathlib import Path

import numpy as np

from refgs.camera import Camera
from refgs.capture.files import Masks, all_found, find_image, photo_view
from refgs.capture.lens import BROWN, Lens, check_intrinsics
from refgs.capture.poses import world_to_camera
from refgs.capture.transforms import camera_name
from refgs.capture.types import View
from refgs.errors import InputError
from refgs.formats.colmap import (
    PARAMETERS,
    UNDISTORT,
    Image,
    Intrinsics,
    model_files,
    read_cameras,
    read_images,
    read_points,
)


def find_model(folder: Path) -> tuple[Path, Path] | None:
    """Return two folders of a capture: that of its photos and that of its sparse model. Return None if there is no model.

    `folder` is the capture's folder, or its subfolder `images_N` with reduced photos.
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
    """Read a COLMAP model. Return its views (photos with cameras), its points (M, 3), and their colours (M, 3) in 0..1.

    Everything is in the model's coordinates. `photos` and `model` are the folders that `find_model` returns. Points and colours are None if
    the model has no file of points. Raises InputError.
    """
    cameras_file, images_file, points_file = model_files(model)
    for file in (cameras_file, images_file):
        if not file.is_file():
            raise InputError(f"{file}: the file is missing. Export the sparse model again.")
    cameras = read_cameras(cameras_file)
    images = sorted(read_images(images_file), key=lambda image: image.name)
    points, colors = read_points(points_file) if points_file.is_file() else (None, None)

    found = [(f"{photos.name}/{image.name}", find_image(photos / image.name, any_suffix=True)) for image in images]
    masks = Masks(masks_root(photos))
    views = []
    for image, path in zip(images, all_found(images_file, found), strict=True):
        where = f"{images_file}, image {image.name}"
        if image.camera_id not in cameras:
            raise InputError(f"{where}: its camera {image.camera_id} is not in {cameras_file.name}. Export it again.")
        mask = masks.find(path, None, where)
        views.append(photo_view(path, _camera(image, cameras[image.camera_id], where), "train", mask, where))
    return views, points, colors


def masks_root(photos: Path) -> Path:
    """Return the folder in which the folder `masks` lies: the one that also has `sparse`. `photos` is the folder of the photos."""
    return photos if (photos / "sparse").is_dir() else photos.parent


def capture_root(folder: Path, layout: str) -> Path:
    """Return the folder in which the folder `masks` of a capture lies. `folder` and `layout` are the capture's."""
    model = find_model(folder) if layout == "colmap" else None
    return folder if model is None else masks_root(model[0])


def _camera(image: Image, intrinsics: Intrinsics, where: str) -> tuple[Camera, Lens | None]:
    model, known = intrinsics.model, PARAMETERS.get(intrinsics.model, ())
    values = dict(zip(known, intrinsics.params, strict=False))
    if "cx" not in values:
        raise InputError(f"{where}: COLMAP's camera model {model} is not known as one of a lens. {UNDISTORT}")
    fx, fy = (values.get(name, values.get("f", 0.0)) for name in ("fx", "fy"))
    cx, cy = values["cx"], values["cy"]
    check_intrinsics((intrinsics.width, intrinsics.height), (fx, fy), (cx, cy), where, "Export the sparse model again.")
    coefficients = intrinsics.params[known.index("cy") + 1 :]
    if not np.isfinite(coefficients).all():
        raise InputError(f"{where}: a distortion coefficient is NaN or infinite. Export the sparse model again.")
    if model in _BROWN:
        model, coefficients = BROWN, _BROWN[model](*coefficients)
    qw, qx, qy, qz, *translation = image.pose
    rotation = _rotation(np.array([qw, qx, qy, qz]))
    # Via camera-to-world, because `world_to_camera` checks poses.
    with np.errstate(over="ignore", invalid="ignore"):
        camera_to_world = np.column_stack([rotation.T, -rotation.T @ translation])
    pose = world_to_camera(camera_to_world, where)
    name = camera_name(image.name)
    camera = Camera(name, intrinsics.width, intrinsics.height, fx, fy, cx, cy, pose)
    lens = Lens(fx, fy, cx, cy, model, coefficients)
    return camera, lens if lens.distorts else None


# Coefficients of Brown's model, from those of COLMAP's models that are special cases of it.
_BROWN = {
    "SIMPLE_PINHOLE": lambda: (0.0,) * 6,
    "PINHOLE": lambda: (0.0,) * 6,
    "SIMPLE_RADIAL": lambda k: (k, 0.0, 0.0, 0.0, 0.0, 0.0),
    "RADIAL": lambda k1, k2: (k1, k2, 0.0, 0.0, 0.0, 0.0),
    "OPENCV": lambda k1, k2, p1, p2: (k1, k2, 0.0, 0.0, p1, p2),
}


def _rotation(q: np.ndarray) -> np.ndarray:
    """Convert a quaternion (w, x, y, z) of any length to a rotation matrix. A zero quaternion gives NaN."""
    with np.errstate(invalid="ignore"):
        q = q / np.abs(q).max()  # first, because squares overflow
        w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
