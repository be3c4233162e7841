"""Read priors: normals and depth that other programs guessed from single photos. Training uses them only early.

Priors are files in the folders `normals` and `depth`, beside the folder `masks`. A prior has the name of its photo, like a mask. Words that
the other program appended to the name are ignored, as in `0001_pred.npy` for the photo `0001.jpg`. A JSON file of cameras may name them,
too. Measured depth, as nerfstudio's files have, is used like guessed depth.
"""

import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from refgs.camera import Camera
from refgs.capture.files import PICTURE_SUFFIXES, Files, fold
from refgs.capture.images import read_codes, read_numbers
from refgs.capture.reduce import reduced_map
from refgs.capture.types import View
from refgs.errors import InputError
from refgs.formats.arrays import read_array
from refgs.formats.exr import read_exr

FOLDERS = {"normals": "prior_normals", "depth": "prior_depth"}  # and the field of a view that has the path
SUFFIXES = (".npy", ".npz", ".exr", *PICTURE_SUFFIXES)  # the first is preferred
SIDE = 512  # pixels of a prior on its longer side: programs guess it from photos of this size or so
SHAPE = 0.02  # part by which a prior's ratio of width and height may differ from its photo's: sizes are rounded
UNIT = 0.5, 1.4  # lengths of an encoded unit vector, blurred or rounded; black and white have 1.73, grey has 0
GREY = 0.02  # difference of a grey picture's channels at the most, of 1; JPEG does not keep them equal


class Prior(NamedTuple):
    """Hold one photo's prior, undistorted and reduced in size: normals or depth that another program estimated.

    `values` are float32, (H, W, 3) for normals or (H, W) for depth, and 0 where unknown. `known` (H, W) marks the known pixels. `camera`
    is the photo's camera for this size.
    """

    values: np.ndarray
    known: np.ndarray
    camera: Camera


def with_priors(views: list[View], root: Path) -> list[View]:
    """Add the paths of priors to the training views that have none yet, and remove those of the others.

    Priors are in the folders `normals` and `depth` of the folder `root`. No file is opened. A file whose name fits no photo is ignored.
    """
    files = Files(root)
    for name, field in FOLDERS.items():
        folder = files.find_folder(name)
        found = {} if folder is None else _find(views, root, folder)
        priors = [(getattr(view, field) or found.get(view)) if view.split == "train" else None for view in views]
        views = [replace(view, **{field: prior}) for view, prior in zip(views, priors, strict=True)]
    return views


def _find(views: list[View], root: Path, folder: Path) -> dict[View, Path]:
    """Map training views to the files in `folder` that fit by name, if any."""
    # A file whose name fits two training photos, or only a held-out one, is not used.
    named: dict[str, list[View]] = {}
    for view in sorted(views, key=lambda view: view.split != "train"):
        parts = view.image_path.relative_to(root).parts if view.image_path.is_relative_to(root) else ()
        for path in (Path(*some) for some in (parts, parts[1:]) if some):
            for name in (path.as_posix(), path.with_suffix("").as_posix()):
                others = named.setdefault(fold(name), [])
                if view.split == "train" or not others:
                    others.append(view)
    found: dict[View, list[Path]] = {}
    for file in sorted(folder.rglob("*")):
        if file.suffix.lower() in SUFFIXES and not file.name.startswith("."):
            name = fold(file.relative_to(folder).as_posix().removesuffix(file.suffix))
            while name not in named and (shorter := re.sub(r"[-_.][^-_./]*$", "", name)) != name:
                name = shorter
            if len(named.get(name, ())) == 1 and named[name][0].split == "train":
                found.setdefault(named[name][0], []).append(file)
    return {view: min(files, key=_preference) for view, files in found.items()}


def _preference(file: Path) -> tuple[int, int]:
    return SUFFIXES.index(file.suffix.lower()), len(file.name)


def load_normals(view: View) -> Prior | None:
    """Load the guessed normals of a view as unit vectors (H, W, 3). Return None if the view has no such file.

    The directions of the file's axes are not known: x may point right or left, and so on. Raises InputError naming the file.
    """
    path = view.prior_normals
    if path is None:
        return None
    values = _read(path, 3)
    if values.min() >= 0:  # encoded: real vectors do not all point into one octant
        values = 2 * values - 1
    length = np.linalg.norm(values, axis=2)
    known = (length > UNIT[0]) & (length < UNIT[1])
    if not known.any():
        raise InputError(f"{path}: there are no normals in it. Save unit vectors, in pictures as (n + 1) / 2.")
    values = values / np.maximum(length, UNIT[0])[..., None]
    mean, known, camera = _fitted(path, view, values, known)
    length = np.linalg.norm(mean, axis=2)
    known &= length > UNIT[0]
    return Prior(np.where(known[..., None], mean / np.maximum(length, UNIT[0])[..., None], 0), known, camera)


def load_depth(view: View) -> Prior | None:
    """Load the guessed depth or disparity of a view (H, W). Return None if the view has no such file.

    The scale and the zero point of the values are not known. Unknown pixels are 0. Raises InputError naming the file.
    """
    path = view.prior_depth
    if path is None:
        return None
    values = _read(path, 1)
    known = values > 0
    if not known.any() or values[known].min() == values.max():
        raise InputError(f"{path}: there is no depth in it: all values are the same. Save it again.")
    return Prior(*_fitted(path, view, np.where(known, values, 0), known))


def _read(path: Path, channels: int) -> np.ndarray:
    """Read a prior's file as float32: (H, W, 3) if `channels` is 3, or (H, W) if it is 1.

    Integers are divided by the largest value of their type, but 32-bit ones of a TIFF are as they are. Values that are not finite become
    0, and so do transparent pixels.
    """
    if path.suffix.lower() in (".npy", ".npz"):
        values = _read_array(path, channels)
    elif path.suffix.lower() == ".exr":
        values = read_exr(path, is_data=True)
        values = values[..., :3] if values.ndim == 3 else values[..., None]
    elif (numbers := read_numbers(path)) is not None:
        values = numbers[..., None]
    else:
        codes, alpha, white = read_codes(path, is_data=True)
        values = codes.astype(np.float32) / white
        if alpha is not None:
            values[alpha < 128] = 0
    values = np.nan_to_num(values, posinf=0, neginf=0)
    if values.shape[2] == 3 and channels == 1:
        if np.ptp(values, axis=2).max() > GREY:
            raise InputError(f"{path}: the depth is in false colours. Save it in grey.")
        values = values[..., :1]
    if values.shape[2] != channels:
        raise InputError(f"{path}: it has {values.shape[2]} channels where there should be {channels}. Save it again.")
    return values if channels > 1 else values[..., 0]


def _read_array(path: Path, channels: int) -> np.ndarray:
    """Read a NumPy file as float32 (H, W, C), also from (C, H, W)."""
    try:
        loaded = read_array(path, "Save it again.")
        values = loaded.astype(np.float32)
    except (OSError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not an array of numbers. Save it again.") from error
    if np.issubdtype(loaded.dtype, np.integer):
        values /= np.iinfo(loaded.dtype).max
    values = values.squeeze()
    if channels == 1 and values.ndim == 2:
        values = values[..., None]
    if values.size == 0 or values.ndim != 3 or channels not in (values.shape[0], values.shape[2]):
        shape = "×".join(map(str, loaded.shape))
        raise InputError(f"{path}: an array of {shape} is no map of {channels} numbers a pixel. Save one a file.")
    return values if values.shape[2] == channels else values.transpose(1, 2, 0)


def _fitted(path: Path, view: View, values: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray, Camera]:
    """Reduce and undistort a prior; return values, known pixels and camera, or raise InputError."""
    height, width = known.shape
    camera = view.camera
    if abs(width / height * camera.height / camera.width - 1) > SHAPE:
        raise InputError(
            f"{path}: it has {width}×{height} pixels, which is not the shape of the photo ({camera.width}×{camera.height}). "
            "Make it from the whole photo, upright."
        )
    small = camera.fitted(min(SIDE, max(width, height)))
    mean, weight = reduced_map(values, known, small)
    known = weight > 0.5
    if view.lens is not None:
        maps = view.lens.resized(small.width / camera.width, small.height / camera.height).maps(small)
        mean[~known] = 0
        mean, share = (cv2.remap(each, *maps, cv2.INTER_LINEAR) for each in (mean, known.astype(np.float32)))
        mean /= np.maximum(share if mean.ndim == 2 else share[..., None], 1e-6)
        known = share > 0.5
    mean[~known] = 0
    return mean, known, small
