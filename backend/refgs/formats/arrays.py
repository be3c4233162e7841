"""Read arrays that NumPy has saved."""

import zipfile
from pathlib import Path

import numpy as np

from refgs.errors import InputError, reason
from refgs.paths import check_file

MOST = 75_000_000  # numbers: normals of a photo of 25 million pixels


def read_array(path: Path, again: str) -> np.ndarray:
    """Read an array from a .npy file, or the first array from a .npz file.

    Raises FileNotFoundError if the file is missing. Raises InputError if the file is broken, holds pickled objects, or declares more
    numbers than the limit MOST. The limit is checked before memory is taken for the array. The message of the InputError ends with `again`,
    advice for the user such as "Save it again."
    """
    try:
        check_file(path)
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive, archive.open(archive.infolist()[0]) as file:
                _check_size(file, path, again)
            with np.load(path, allow_pickle=False) as arrays:
                return next(iter(arrays.values()))
        with open(path, "rb") as file:
            _check_size(file, path, again)
        return np.load(path, allow_pickle=False)
    except (FileNotFoundError, InputError):
        raise
    except Exception as error:  # NumPy evaluates the header, and raises errors of many types
        raise InputError(f"{path}: not an array of NumPy ({reason(error)}). {again}") from error


def _check_size(file, path: Path, again: str) -> None:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape = read(file)[0]
    if np.prod([*map(int, shape)], dtype=object) > MOST:
        raise InputError(f"{path}: an array of {'×'.join(map(str, shape))} has more than {MOST:,} numbers. {again}")
