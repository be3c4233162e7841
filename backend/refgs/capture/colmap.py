"""Read COLMAP captures: a sparse model, binary or text, with photos in `images`, `input` or the capture's folder.

The model is in one of the folders _MODELS. Some data sets, such as the real scenes of Ref-NeRF and mip-NeRF 360, also have reduced photos
in `images_2`, `images_4` and `images_8`. To use reduced photos, pass the path of their folder in place of the capture's. Reduced photos may
have another file suffix than the one in the model.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from refgs.camera import Camera
from refgs.capture.files import PHOTO_FOLDERS, Files, fold, leave_out_missing, photo_folder, photo_view
from refgs.capture.lens import BROWN, Lens, check_intrinsics
from refgs.capture.mask_files import find_masks
from refgs.capture.poses import world_to_camera
from refgs.capture.transforms import camera_name
from refgs.capture.types import View
from refgs.errors import InputError
from refgs.formats.colmap import (
    PARAMETERS,
    UNDISTORT,
    Image,
    Intrinsics,
    count_images,
    model_files,
    read_cameras,
    read_images,
    read_points,
)


class Model(NamedTuple):
    """Hold where a COLMAP capture's files are: its sparse model `folder` and the folder of its `photos`.

    `root` is the folder that holds the folder `masks`. `others` lists the capture's other models, which are not used: a pair (folder,
    number of photos) for each.
    """

    folder: Path
    photos: Path
    root: Path
    others: list[tuple[Path, int]]


def find_model(folder: Path) -> Model | None:
    """Find a capture's COLMAP model. If there are several, return the one with the most photos. Return None if there is none.

    Of models with equally many photos, the one whose folder comes first in _MODELS is returned. `folder` is the capture's folder, or its
    subfolder `images_N` with reduced photos.
    """
    reduced = re.fullmatch(r"images_\d+", folder.name) is not None
    top = folder.parent if reduced else folder
    found = [path for pattern in _MODELS for path in _sorted(top, pattern) if _is_model(path, pattern)]
    if not found:
        return None
    counts = {path: _registered(path) if len(found) > 1 else 0 for path in found}
    found.sort(key=counts.__getitem__, reverse=True)
    model, *others = found
    rest = [(other, counts[other]) for other in others]
    if reduced:
        return Model(model, folder, top, rest)
    # COLMAP's image_undistorter writes photos of its own beside the model.
    for above in (model.parent, model.parent.parent):
        if above != top and above.is_relative_to(top) and (above / "images").is_dir():
            return Model(model, above / "images", top, rest)
    return Model(model, photo_folder(Files(top)), top, rest)


# Where COLMAP and the programs that call it put models.
_MODELS = (
    *("sparse/*", "sparse", "colmap/sparse/*", "colmap/sparse", "colmap"),
    *("dense/sparse/*", "dense/sparse", "dense/*/sparse", "distorted/sparse/*", "."),
)


def _sorted(top: Path, pattern: str) -> list[Path]:
    """Return the folders below `top` that match a glob pattern, in numeric order."""
    if pattern == ".":
        return [top]
    # A folder `colmap` with photos is a capture of its own, in a folder of captures.
    if pattern.startswith("colmap") and (top / "colmap" / "images").is_dir():
        return []
    found = (path for path in top.glob(pattern) if not path.name.startswith("."))
    return sorted(found, key=lambda path: (len(path.name), path.name))


def _is_model(folder: Path, pattern: str) -> bool:
    """Tell whether a folder has a model, even an incomplete one below `sparse`."""
    # Reading an incomplete model raises an error that names the missing file.
    there = [any((folder / f"{name}.{end}").is_file() for end in ("bin", "txt")) for name in ("cameras", "images")]
    return any(there) if pattern.startswith("sparse") else all(there)


def _registered(model: Path) -> int:
    """Count a model's photos, 0 if they cannot be read."""
    try:
        return count_images(model_files(model)[1])
    except InputError:
        return 0


def read_colmap(model: Model) -> tuple[list[View], np.ndarray | None, np.ndarray | None, list[str]]:
    """Read a COLMAP model. Return its views (photos with cameras), its points (M, 3), their colours (M, 3) in 0..1, and warnings.

    Everything is in the model's coordinates. Points and colours are None if the model has no file of points. Raises InputError.
    """
    cameras_file, images_file, points_file = model_files(model.folder)
    for file in (cameras_file, images_file):
        if not file.is_file():
            raise InputError(f"{file}: the file is missing. Export the sparse model again.")
    cameras = read_cameras(cameras_file)
    images = sorted(read_images(images_file), key=lambda image: image.name)
    points, colors = read_points(points_file) if points_file.is_file() else (None, None)

    photos, files = Files(model.photos), Files(model.root)
    named = [(image, f"{model.photos.name}/{image.name}", _find(photos, image.name)) for image in images]
    found, warnings = leave_out_missing(images_file, named)
    masks = find_masks(files, [photo for _, photo in found])
    views = []
    for image, path in found:
        where = f"{images_file}, image {image.name}"
        if image.camera_id not in cameras:
            raise InputError(f"{where}: its camera {image.camera_id} is not in {cameras_file.name}. Export it again.")
        camera = _camera(image, cameras[image.camera_id], where)
        views.append(photo_view(path, camera, "train", masks.get(path), where))
    return views, points, colors, [*_passed_over(model, len(images)), *warnings]


def _passed_over(model: Model, count: int) -> list[str]:
    """Return one line about the unused models, where `model` has `count` photos, or []."""
    if not model.others:
        return []
    other, photos = model.others[0]
    ours, first = (path.relative_to(model.root).as_posix() for path in (model.folder, other))
    what = f"{len(model.others) + 1} COLMAP models: {ours} is used, as no other has more than its {count} photos"
    return [f"{what}; {len(model.others)} not used, first {first} ({photos} photos)"]


def _find(photos: Files, name: str) -> Path | None:
    """Find a photo by the model's name for it. Return None if it is missing."""
    # If COLMAP was run on the folder above that of the photos, the name begins with a folder `images` or `input`.
    first, _, rest = name.replace("\\", "/").partition("/")
    return photos.find(name) or (photos.find(rest) if fold(first) in PHOTO_FOLDERS else None)


def capture_root(folder: Path, layout: str) -> Path:
    """Return the folder that holds a capture's `masks`, which depends on its `layout`."""
    model = find_model(folder) if layout == "colmap" else None
    return folder if model is None else model.root


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
