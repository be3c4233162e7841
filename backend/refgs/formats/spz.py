"""Write splats as SPZ, version 4, and read versions 2 to 4.

Niantic's README of the format (github.com/nianticlabs/spz) defines the layout, and its library the steps of the numbers. SPZ has no
materials and no normals. Its axes are x right, y up, z backward.
"""

import gzip
import os
import struct
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np
import zstandard
from plyfile import PlyData, PlyElement

from refgs.errors import InputError, reason
from refgs.formats.splats import Splats, splats_of_ply, three_scales
from refgs.paths import open_file, whole

MAGIC, VERSION = b"NGSP", 4
MOST_BITS = 23  # behind the point of a position of 24 bits
MOST_DEGREE = 3  # of spherical harmonics that are kept: SPZ knows a fourth
COLOR, SCALE, LEAST_SCALE = 0.15 * 255, 16.0, -10.0  # steps of f_dc and of log scales
_HEADER = struct.Struct("<4sIIBBBBI12x")  # of version 4
_OLD_HEADER = struct.Struct("<4sIIBBBx")  # of versions 2 and 3, inside gzip
_STREAM = struct.Struct("<QQ")  # bytes of a stream, compressed and not
_GZIP = b"\x1f\x8b"
_RATIO = 2048  # gzip and Zstandard compress less than this, so that a header cannot ask for more memory
_BROKEN = gzip.BadGzipFile, EOFError, struct.error, zlib.error, zstandard.ZstdError, ValueError, MemoryError
_AGAIN = "copy or export it again"


def write_spz(path: str | os.PathLike, splats: Splats) -> None:
    """Write splats as an SPZ file for viewers: colours and shapes, but no materials.

    The splats must have SPZ's axes, which are glTF's: see `refgs.export.turned`. Positions get as many bits behind the point as fit.
    Harmonics of degree 1 get 5 bits and higher ones 4, which Niantic's library writes, too.

    Raises InputError if a position is farther from the origin than SPZ can say.
    """
    farthest = float(np.abs(splats.positions).max(initial=0))
    bits = next((bits for bits in range(MOST_BITS, -1, -1) if round(farthest * 2**bits) < 1 << 23), None)
    if bits is None:
        raise InputError(f"{path}: splats are {farthest:g} units from the origin, too far for SPZ: write a .ply")
    count, coefficients = splats.sh.shape[:2]
    fixed = np.rint(splats.positions.astype(np.float64) * 2**bits).astype("<i4")
    streams = [
        fixed[..., None].view("u1")[..., :3],
        _byte(splats.opacities * 255.0),
        _byte(splats.sh[:, 0] * COLOR + 127.5),
        _byte((np.log(np.maximum(three_scales(splats), 1e-30)) - LEAST_SCALE) * SCALE),
        _smallest_three(splats.rotations),
        _harmonics(splats.sh[:, 1:]),
    ]
    compressor = zstandard.ZstdCompressor()
    raw = [np.ascontiguousarray(stream).tobytes() for stream in streams]
    packed = [compressor.compress(data) for data in raw]
    degree = int(coefficients**0.5) - 1
    with whole(Path(path)) as temporary, open(temporary, "wb") as file:
        file.write(_HEADER.pack(MAGIC, VERSION, count, degree, bits, 0, len(packed), _HEADER.size))
        file.write(b"".join(_STREAM.pack(len(small), len(data)) for small, data in zip(packed, raw, strict=True)))
        file.write(b"".join(packed))


def _byte(values: np.ndarray) -> np.ndarray:
    return np.rint(values).clip(0, 255).astype(np.uint8)


def _smallest_three(rotations: np.ndarray) -> np.ndarray:
    """Encode unit quaternions wxyz (N, 4) in 32 bits: which of xyzw is largest (2 bits), and sign and size (1 + 9 bits) of the others."""
    xyzw = rotations[:, [1, 2, 3, 0]].astype(np.float64)
    largest = np.abs(xyzw).argmax(axis=1)
    rows = np.arange(len(xyzw))
    xyzw *= np.where(xyzw[rows, largest] < 0, -1, 1)[:, None]  # the largest is read as positive
    code = largest.astype("<u4")
    for axis in range(4):
        size = np.rint(np.abs(xyzw[:, axis]) * np.sqrt(2) * 511).clip(0, 511).astype("<u4")
        code = np.where(axis == largest, code, (code << 10) | ((xyzw[:, axis] < 0).astype("<u4") << 9) | size)
    return code.astype("<u4")


def _harmonics(rest: np.ndarray) -> np.ndarray:
    """Encode harmonics (N, K, 3) of degree 1 and above in bytes, in steps of 8 for degree 1 and of 16 above."""
    step = np.where(np.arange(rest.shape[1]) < 3, 8, 16)[:, None]
    return _byte(np.rint((rest * 128.0 + 128) / step) * step)


def read_spz(path: str | os.PathLike) -> Splats:
    """Read the splats of an SPZ file. They become what `read_splats` makes of the same splats in a PLY file of 3DGS.

    The axes stay SPZ's. Harmonics above degree 3 are left out. Extensions, of cameras say, are ignored.

    Raises InputError for a file that is missing, not SPZ, of another version, truncated, or too small for the splats that it declares.
    """
    path = Path(path)
    try:
        with open_file(path) as file:
            facts, streams = _unpack(file, path)
    except _BROKEN as error:
        raise InputError(f"{path} is not a whole SPZ file ({reason(error)}): {_AGAIN}") from None
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from None
    count, degree, bits, version = facts
    positions, alphas, colors, scales, rotations, harmonics = (np.frombuffer(stream, np.uint8) for stream in streams)
    fixed = np.zeros((count, 3, 4), np.uint8)
    fixed[..., 1:] = positions.reshape(count, 3, 3)  # the upper bytes: the sign comes along
    rest = (degree + 1) ** 2 - 1
    kept = min(rest, (MOST_DEGREE + 1) ** 2 - 1)
    harmonics = harmonics.reshape(count, rest, 3)[:, :kept].transpose(0, 2, 1).reshape(count, 3 * kept)
    with np.errstate(divide="ignore"):
        alpha = alphas / np.float32(255)
        opacity = np.log(alpha) - np.log1p(-alpha)
    turn = _read_largest(rotations) if version == 2 else _read_smallest_three(rotations)
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)  # three coarse numbers may be longer than one
    columns = {
        ("x", "y", "z"): (fixed.view("<i4")[..., 0] >> 8) / np.float64(2) ** bits,
        ("f_dc_0", "f_dc_1", "f_dc_2"): (colors.reshape(count, 3) - 127.5) / COLOR,
        tuple(f"f_rest_{i}" for i in range(3 * kept)): (harmonics - 128.0) / 128,
        ("opacity",): opacity[:, None],
        ("scale_0", "scale_1", "scale_2"): scales.reshape(count, 3) / SCALE + LEAST_SCALE,
        ("rot_1", "rot_2", "rot_3", "rot_0"): turn,
    }
    rows = np.empty(count, [(name, "<f4") for names in columns for name in names])
    for names, values in columns.items():
        for i, name in enumerate(names):
            rows[name] = values[:, i]
    return splats_of_ply(PlyData([PlyElement.describe(rows, "vertex")]), path)


def _unpack(file: BinaryIO, path: Path) -> tuple[tuple[int, int, int, int], list[bytes]]:
    """Check a file's header. Returns (count, degree, bits behind the point, version), and its six streams without compression."""
    start = file.read(4)
    file.seek(0)
    old = start[:2] == _GZIP
    if not old and start != MAGIC:
        raise InputError(f"{path} is not an SPZ file: choose another")
    body = gzip.GzipFile(fileobj=file) if old else file
    header = _OLD_HEADER if old else _HEADER
    magic, version, count, degree, bits, *more = header.unpack(body.read(header.size))
    if magic != MAGIC:
        raise InputError(f"{path} is not an SPZ file: choose another")
    if version not in ((2, 3) if old else (4,)):
        raise InputError(f"{path} is SPZ of version {version}, but versions 2 to 4 are read: {_AGAIN}")
    if degree > 4 or bits > MOST_BITS:
        raise ValueError("its header is broken")
    lengths = [count * width for width in (9, 1, 3, 3, 3 if version == 2 else 4, 3 * ((degree + 1) ** 2 - 1))]
    if sum(lengths) > _RATIO * os.fstat(file.fileno()).st_size:
        raise ValueError(f"its header says {count:,} splats")
    found = [body.read(length) for length in lengths] if old else _streams(file, more[1], more[2], lengths)
    if [len(stream) for stream in found] != lengths:
        raise ValueError("it is truncated")
    return (count, degree, bits, version), found


def _streams(file: BinaryIO, count: int, table: int, lengths: list[int]) -> list[bytes]:
    """Read the streams of version 4, of which a table at the byte `table` lists `count`. An empty stream may be missing."""
    if count < sum(map(bool, lengths)):
        raise ValueError("it lacks streams")
    file.seek(table)
    sizes = [*_STREAM.iter_unpack(file.read(count * _STREAM.size)), (0, 0)][: len(lengths)]
    found = []
    for length, (small, large) in zip(lengths, sizes, strict=True):
        if large != length or small > 2 * length + 1000:  # Zstandard hardly lengthens what it cannot compress
            raise ValueError("its streams have another length than its header says")
        packed = file.read(small)
        found.append(zstandard.ZstdDecompressor().decompress(packed, length) if length else b"")
    return found


def _read_largest(data: np.ndarray) -> np.ndarray:
    """Decode quaternions of version 2, as xyzw (N, 4): x, y and z in bytes, and w not negative."""
    xyz = data.reshape(-1, 3) / 127.5 - 1
    return np.column_stack([xyz, np.sqrt(np.maximum(0, 1 - np.square(xyz).sum(axis=1)))])


def _read_smallest_three(data: np.ndarray) -> np.ndarray:
    """Decode quaternions of `_smallest_three`, as xyzw (N, 4)."""
    code = data.view("<u4").copy()
    largest, xyzw = code >> 30, np.zeros((len(code), 4))
    for axis in (3, 2, 1, 0):  # the last one is in the lowest bits
        here = axis != largest
        size = (code & 511) / (511 * np.sqrt(2))
        xyzw[:, axis] = np.where(here, np.where(code & 512, -size, size), 0)
        code = np.where(here, code >> 10, code)
    xyzw[np.arange(len(code)), largest] = np.sqrt(np.maximum(0, 1 - np.square(xyzw).sum(axis=1)))
    return xyzw
