"""Read pickled NumPy arrays safely.

`pickle.load` can call any function that the file names, and captures come from untrusted sources. This reader accepts only the few classes
and functions that pickled arrays need. It replaces each one by a class or function of this module, which only keeps an array's bytes, shape
and type. The array is made later, from these three. A file that names any other class or function is refused.
"""

import io
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Literal, cast

import numpy as np

from refgs.errors import InputError, reason
from refgs.paths import open_file

LARGEST = 1 << 20  # bytes; a camera takes a few hundred, a split a few thousand
KINDS = ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")


def read_pair(file: Path) -> tuple[np.ndarray | list[int | str], np.ndarray | list[int | str]]:
    """Read a pickle of two arrays or lists. Raises InputError for anything else."""
    try:
        with open_file(file) as source:
            data = source.read(LARGEST + 1)
        if len(data) > LARGEST:
            raise InputError(f"{file}: larger than a camera or a split can be. Download the data set again.")
        first, second = _Arrays(io.BytesIO(data)).load()
        return _plain(first), _plain(second)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{file}: the file is missing. Download the data set again.") from None
    except _Refused as error:
        raise InputError(f"{file}: holds {error}, not only arrays, so it was not opened. Do not trust it.") from None
    except Exception as error:
        raise InputError(f"{file}: not a pickle of arrays ({reason(error)}). Download the data set again.") from error


class _Refused(Exception):
    pass


class _Dtype:
    """Replace numpy.dtype while a pickle is read, keeping type code and byte order."""

    def __init__(self, kind: str, *_):
        self.kind, self.order = kind, "="

    def __setstate__(self, state: tuple):
        self.order = state[1].replace("|", "=")


class _Array:
    """Replace numpy.ndarray while a pickle is read, until `numpy()` makes the array."""

    def __setstate__(self, state: tuple):
        _, self.shape, self.dtype, fortran, self.data = state
        self.order: Literal["C", "F"] = "F" if fortran else "C"

    def numpy(self) -> np.ndarray:
        kind = self.dtype.kind.lstrip("<>=|")
        if kind not in KINDS:
            raise ValueError(f"an array of {kind!r}")
        numbers = np.frombuffer(self.data, self.dtype.order + kind)
        return numbers.reshape(self.shape, order=self.order).astype(kind)


def _array(*_) -> _Array:
    return _Array()


def _from_buffer(data, dtype, shape, order) -> _Array:
    result = _Array()
    result.__setstate__((1, shape, dtype, order == "F", data))
    return result


def _scalar(dtype, data) -> _Array:
    return _from_buffer(data, dtype, (), "C")


def _encode(text: str, encoding: str) -> bytes:
    if encoding != "latin1":
        raise _Refused(f"text in {encoding}")
    return text.encode("latin1")  # protocols before 3 write bytes as latin1 text


# Names as written by NumPy before and since release 2.
_NAMES = {("numpy", "ndarray"): _Array, ("numpy", "dtype"): _Dtype, ("_codecs", "encode"): _encode}
for _core in ("numpy.core", "numpy._core"):
    _NAMES[f"{_core}.multiarray", "_reconstruct"] = _array
    _NAMES[f"{_core}.multiarray", "scalar"] = _scalar
    _NAMES[f"{_core}.numeric", "_frombuffer"] = _from_buffer


_Step = Callable[[pickle.Unpickler], None]


class _Arrays(pickle._Unpickler):
    """Read a pickle with only `_NAMES`; C's unpickler would let files reserve gigabytes."""

    read: Callable[[int], bytes]  # `load` sets these two
    append: Callable[[object], None]

    def load_bytearray8(self) -> None:
        self.append(bytearray(self.read(int.from_bytes(self.read(8), "little"))))  # `pickle` reserves the bytes first

    dispatch = pickle._Unpickler.dispatch | {pickle.BYTEARRAY8[0]: cast(_Step, load_bytearray8)}

    def find_class(self, module: str, name: str):
        try:
            return _NAMES[module, name]
        except KeyError:
            raise _Refused(f"{module}.{name}") from None


def _plain(part: object) -> np.ndarray | list:
    if isinstance(part, _Array):
        return part.numpy()
    if not isinstance(part, list | tuple):
        raise ValueError(f"a {type(part).__name__}")
    numbers = [item.numpy().item() if isinstance(item, _Array) else item for item in part]
    if not all(isinstance(number, int | str) for number in numbers):
        raise ValueError("a list of something else than numbers")
    return numbers
