"""Read splats in SPZ, versions 2 to 4, without bpy. The trainer has another reader: both must accept and refuse the same files.

Niantic's README of the format (github.com/nianticlabs/spz) defines the layout, and its library the steps of the numbers.
"""

import gzip
import os
import struct
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np

from .errors import InputError
from .ordinary import open_file

SUFFIX, MAGIC = ".spz", b"NGSP"
_HEADER = struct.Struct("<4sIIBBBBI12x")  # of version 4
_OLD_HEADER = struct.Struct("<4sIIBBBx")  # of versions 2 and 3, inside gzip
_STREAM = struct.Struct("<QQ")  # bytes of a stream, compressed and not
_RATIO = 2048  # gzip and Zstandard compress less than this, so that a header cannot ask for more memory
_AGAIN = "copy or export it again"


def read_spz_rows(path: Path) -> np.ndarray:
    """Read the splats of an SPZ file as rows of a PLY of 3DGS, float32, without spherical harmonics above the constant one.

    SPZ has Y up. The rows are turned to Blender's axes. Raises InputError if the file is missing, broken or of another version.
    """
    try:
        with open_file(path) as file:
            count, bits, version, streams = _unpack(file, path)
    except (gzip.BadGzipFile, EOFError, struct.error, zlib.error, ValueError, MemoryError) as error:
        raise InputError(f"{path} is not a whole SPZ file ({error}): {_AGAIN}") from None
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    positions, alphas, colors, scales, turns = (np.frombuffer(stream, np.uint8) for stream in streams)
    fixed = np.zeros((count, 3, 4), np.uint8)
    fixed[..., 1:] = positions.reshape(count, 3, 3)  # the upper bytes: the sign comes along
    x, y, z = ((fixed.view("<i4")[..., 0] >> 8) / np.float64(2) ** bits).T
    with np.errstate(divide="ignore"):
        alpha = alphas / np.float32(255)
        opacity = np.log(alpha) - np.log1p(-alpha)
    turn = _read_largest(turns) if version == 2 else _read_smallest_three(turns)
    a, b, c, d = (turn / np.linalg.norm(turn, axis=1, keepdims=True)).T  # x, y, z, w
    half = np.sqrt(0.5)  # a quarter turn about x, after that of the splat
    values = {
        **{"x": x, "y": -z, "z": y, "opacity": opacity},
        **{"rot_0": half * (d - a), "rot_1": half * (a + d), "rot_2": half * (b - c), "rot_3": half * (c + b)},
        **{f"f_dc_{i}": column for i, column in enumerate((colors.reshape(count, 3).T - 127.5) / (0.15 * 255))},
        **{f"scale_{i}": column for i, column in enumerate(scales.reshape(count, 3).T / 16 - 10)},
    }
    rows = np.empty(count, [(name, "<f4") for name in values])
    for name, column in values.items():
        rows[name] = column
    return rows


def _unpack(file: BinaryIO, path: Path) -> tuple[int, int, int, list[bytes]]:
    """Check a file's header. Returns the count, the bits behind the point, the version, and the streams without the harmonics."""
    start = file.read(4)
    file.seek(0)
    old = start[:2] == b"\x1f\x8b"
    if not old and start != MAGIC:
        raise InputError(f"{path} is not an SPZ file: choose another")
    body = gzip.GzipFile(fileobj=file) if old else file
    header = _OLD_HEADER if old else _HEADER
    magic, version, count, degree, bits, *more = header.unpack(body.read(header.size))
    if magic != MAGIC:
        raise InputError(f"{path} is not an SPZ file: choose another")
    if version not in ((2, 3) if old else (4,)):
        raise InputError(f"{path} is SPZ of version {version}, but versions 2 to 4 are read: {_AGAIN}")
    if degree > 4 or bits > 23:
        raise ValueError("its header is broken")
    lengths = [count * width for width in (9, 1, 3, 3, 3 if version == 2 else 4, 3 * ((degree + 1) ** 2 - 1))]
    if sum(lengths) > _RATIO * os.fstat(file.fileno()).st_size:
        raise ValueError(f"its header says {count:,} splats")
    found = [body.read(length) for length in lengths] if old else _streams(file, more[1], more[2], lengths)
    if [len(stream) for stream in found] != lengths:
        raise ValueError("it is truncated")
    return count, bits, version, found[:5]


def _streams(file: BinaryIO, count: int, table: int, lengths: list[int]) -> list[bytes]:
    """Read the streams of version 4, of which a table at the byte `table` lists `count`. An empty stream may be missing."""
    import zstandard  # Blender brings it

    if count < sum(map(bool, lengths)):
        raise ValueError("it lacks streams")
    file.seek(table)
    sizes = [*_STREAM.iter_unpack(file.read(count * _STREAM.size)), (0, 0)][: len(lengths)]
    found = []
    for length, (small, large) in zip(lengths, sizes, strict=True):
        if large != length or small > 2 * length + 1000:  # Zstandard hardly lengthens what it cannot compress
            raise ValueError("its streams have another length than its header says")
        packed = file.read(small)
        try:
            found.append(zstandard.ZstdDecompressor().decompress(packed, length) if length else b"")
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from None
    return found


def _read_largest(data: np.ndarray) -> np.ndarray:
    """Decode quaternions of version 2, as xyzw (N, 4): x, y and z in bytes, and w not negative."""
    xyz = data.reshape(-1, 3) / 127.5 - 1
    return np.column_stack([xyz, np.sqrt(np.maximum(0, 1 - np.square(xyz).sum(axis=1)))])


def _read_smallest_three(data: np.ndarray) -> np.ndarray:
    """Decode quaternions of later versions, as xyzw (N, 4): 2 bits say which is largest, 10 each are the others' sign and size."""
    code = data.view("<u4").copy()
    largest, xyzw = code >> 30, np.zeros((len(code), 4))
    for axis in (3, 2, 1, 0):  # the last one is in the lowest bits
        here = axis != largest
        size = (code & 511) / (511 * np.sqrt(2))
        xyzw[:, axis] = np.where(here, np.where(code & 512, -size, size), 0)
        code = np.where(here, code >> 10, code)
    xyzw[np.arange(len(code)), largest] = np.sqrt(np.maximum(0, 1 - np.square(xyzw).sum(axis=1)))
    return xyzw
