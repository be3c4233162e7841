"""Make ICC profiles, and files that declare their colours in other ways."""

import itertools
import struct
import zlib
from pathlib import Path

import numpy as np

# Colorants of profiles: the columns are XYZ of red, green and blue, adapted to D50. Those of sRGB are LittleCMS's, the others published.
SRGB = np.array(
    [
        [0.43604125, 0.38511291, 0.14304584],
        [0.22248454, 0.71690508, 0.06061038],
        [0.01392019, 0.09706724, 0.71391257],
    ]
)
DISPLAY_P3 = np.array([[0.51512, 0.29198, 0.15710], [0.24120, 0.69225, 0.06657], [-0.00105, 0.04189, 0.78407]])
ADOBE_RGB = np.array([[0.60974, 0.20528, 0.14919], [0.31111, 0.62567, 0.06322], [0.01947, 0.06087, 0.74457]])
PROPHOTO = np.array([[0.79767, 0.13519, 0.03134], [0.28804, 0.71188, 0.00009], [0.0, 0.0, 0.82491]])

SRGB_CURVE = (3, (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045))  # form and parameters


def gamma(value: float) -> bytes:
    """Make a curve that is a power."""
    return b"curv" + struct.pack(">IIH", 0, 1, round(value * 256))


def table(values: np.ndarray) -> bytes:
    """Make a curve from linear values 0..1 at evenly spaced codes."""
    return b"curv" + struct.pack(f">II{len(values)}H", 0, len(values), *np.rint(values * 65535).astype(int))


def formula(form: int, parameters: tuple[float, ...]) -> bytes:
    """Make a parametric curve (ICC.1:2022, 10.18)."""
    return b"para" + struct.pack(f">IHH{len(parameters)}i", 0, form, 0, *(round(value * 65536) for value in parameters))


def matrix_profile(colorants: np.ndarray, curve: bytes) -> bytes:
    """Make the profile of an RGB space."""
    columns = {name: _xyz(column) for name, column in zip((b"rXYZ", b"gXYZ", b"bXYZ"), colorants.T, strict=True)}
    return _profile(b"RGB ", b"XYZ ", columns | dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve))


def grey_profile(curve: bytes) -> bytes:
    """Make the profile of greyscale pictures."""
    return _profile(b"GRAY", b"XYZ ", {b"kTRC": curve})


def table_profile(space: bytes, channels: int, lab) -> bytes:
    """Make a profile from a table: `lab` returns the CIE Lab of the corners (channels,) of 0 and 1. Between them it is interpolated."""
    corners = [lab(corner) for corner in itertools.product((0, 1), repeat=channels)]
    encoded = [(round(L * 2.55), round(a + 128), round(b + 128)) for L, a, b in corners]
    ramp = bytes(range(256))
    head = (
        b"mft1"
        + struct.pack(">IBBBB", 0, channels, 3, 2, 0)
        + struct.pack(">9i", *np.eye(3, dtype=int).ravel() * 65536)
    )
    body = head + ramp * channels + bytes(itertools.chain(*encoded)) + ramp * 3
    return _profile(space, b"Lab ", {b"A2B0": body})


def add_chunk(path: Path, name: bytes, data: bytes) -> None:
    """Add a chunk to a PNG, behind its first."""
    png, body = path.read_bytes(), name + data
    added = struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))
    path.write_bytes(png[:33] + added + png[33:])


def srgb_decoded(codes: np.ndarray) -> np.ndarray:
    """Decode sRGB, 0..1, in float64, as IEC 61966-2-1 says."""
    codes = np.asarray(codes, np.float64)
    return np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)


def srgb_encoded(linear: np.ndarray) -> np.ndarray:
    """Encode sRGB in float64, clipped to 0..1."""
    linear = np.clip(np.asarray(linear, np.float64), 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def _xyz(values: np.ndarray) -> bytes:
    return b"XYZ " + struct.pack(">I3i", 0, *np.rint(np.asarray(values) * 65536).astype(int))


def _profile(space: bytes, connection: bytes, tags: dict[bytes, bytes]) -> bytes:
    text = b"made for a test\0"
    tags = {
        b"desc": b"desc" + struct.pack(">II", 0, len(text)) + text + bytes(78),
        b"cprt": b"text" + bytes(4) + text,
        b"wtpt": _xyz((0.9642, 1, 0.8249)),
        **tags,
    }
    start, entries, body = 132 + 12 * len(tags), b"", b""
    for name, tag in tags.items():
        entries += name + struct.pack(">II", start + len(body), len(tag))
        body += tag + bytes(-len(tag) % 4)
    kind = b"prtr" if space == b"CMYK" else b"mntr"
    head = struct.pack(">I4sI4s4s4s", start + len(body), b"none", 0x02400000, kind, space, connection)
    head += struct.pack(">6H4s4sI4s4sII3i", 2024, 1, 1, 0, 0, 0, b"acsp", b"APPL", 0, b"none", b"none", 0, 0, 0, 0, 0)
    head = head[:68] + struct.pack(">3i", 63190, 65536, 54061)
    return head.ljust(128, b"\0") + struct.pack(">I", len(tags)) + entries + body
