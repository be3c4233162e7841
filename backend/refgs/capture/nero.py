"""Read captures of NeRO's data set Glossy Synthetic: `0.png`, `0-depth.png`, `0-camera.pkl` and so on in one folder.

The layout is that of `GlossySyntheticDatabase` in NeRO's `dataset/database.py` (Liu et al. 2023). A camera is a pickle of two arrays: world
to camera (3, 4) with OpenCV's axes, and the intrinsic matrix (3, 3). A depth map stores 0 to 15 units in 16 bits. Depth beyond 14.5 is
background, smaller depth is the object; this makes the mask. A photo without a depth map may have a mask file (see `find_masks`).
`synthetic_split_128.pkl`, from NeRO's folder `configs`, lists first the numbers of the test views, then those of the training views. It may
be in the scene's folder or in the folder above.
"""

from pathlib import Path

import numpy as np

from refgs.camera import Camera
from refgs.capture.files import Files, leave_out_missing, photo_view
from refgs.capture.images import read_header
from refgs.capture.lens import check_intrinsics
from refgs.capture.mask_files import find_masks
from refgs.capture.pickles import read_pair
from refgs.capture.poses import world_to_camera
from refgs.capture.types import View
from refgs.errors import InputError

SPLIT = "synthetic_split_128.pkl"
FAR = 14.5 / 15  # part of a depth map's range at which the background begins


def read_nero(folder: Path) -> tuple[list[View], list[str]]:
    """Read a NeRO capture's views in its own coordinates, and warnings. Raises InputError."""
    names = (file.name.removesuffix("-camera.pkl") for file in folder.glob("*-camera.pkl"))
    numbers = sorted(int(name) for name in names if name.isdecimal())
    files = Files(folder)
    found = [(number, f"{number}.png", files.find(f"{number}.png")) for number in numbers]
    photos, lost = leave_out_missing(folder, found)
    masks = find_masks(files, [photo for _, photo in photos])
    tested, warnings = _test_numbers(folder, numbers)
    views = []
    for number, photo in photos:
        file = folder / f"{number}-camera.pkl"
        depth = files.find(f"{number}-depth.png", suffixes=False)
        split = "test" if number in tested else "train"
        camera = _camera(file, str(number), *read_header(photo)[:2])
        mask, below = (depth, FAR) if depth is not None else (masks.get(photo), None)
        views.append(photo_view(photo, (camera, None), split, mask, str(file), mask_below=below))
    return views, [*warnings, *lost]


def _camera(file: Path, name: str, width: int, height: int) -> Camera:
    pose, matrix = read_pair(file)
    if np.shape(pose) != (3, 4) or np.shape(matrix) != (3, 3):
        raise InputError(f"{file}: not a (3, 4) pose and a (3, 3) intrinsic matrix. Download the data set again.")
    (fx, skew, cx), (_, fy, cy), _ = np.asarray(matrix, float).tolist()
    if not abs(skew) <= 1e-6 * fx:
        raise InputError(f"{file}: the focal length is zero, negative or NaN, or the pixels are skewed. Correct it.")
    check_intrinsics((width, height), (fx, fy), (cx, cy), str(file), "Correct it.")
    try:
        inverse = np.linalg.inv(np.vstack([pose, [0, 0, 0, 1]]))
    except np.linalg.LinAlgError:
        inverse = np.zeros((3, 4))  # `world_to_camera` reports it
    return Camera(name, width, height, fx, fy, cx, cy, world_to_camera(inverse, str(file)))


def _test_numbers(folder: Path, numbers: list[int]) -> tuple[set[int], list[str]]:
    """Return the test views by NeRO's split file, or every eighth with a warning."""
    file = next((path for path in (folder / SPLIT, folder.parent / SPLIT) if path.is_file()), None)
    if file is None:
        warning = f"{SPLIT} of NeRO is neither in the scene's folder nor beside it: every eighth view is tested on"
        return set(numbers[::8]), [warning]
    try:
        test, train = ({int(number) for number in part} for part in read_pair(file))
    except (TypeError, ValueError):
        raise InputError(
            f"{file}: not the numbers of the test views and of the training views. Download it again."
        ) from None
    if test & train or test | train != set(numbers):
        raise InputError(
            f"{file}: it splits {len(test)} + {len(train)} views, which are not the {len(numbers)} of {folder}. "
            "Remove it, or use the one that belongs to the data."
        )
    return test, []
