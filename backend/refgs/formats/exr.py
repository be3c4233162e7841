"""Read and write OpenEXR pictures."""

import errno
import os
from pathlib import Path

import numpy as np
import OpenEXR

from refgs.color import REC709, primaries_to_rec709
from refgs.errors import InputError
from refgs.formats.pixels import check_pixels
from refgs.paths import whole

# A larger picture than a panorama of 8192×4096, with so many pixels a byte, is taken for a broken one: deflate packs 1032 bytes into one.
_FEWEST = 40_000_000, 1032


def write_exr(path: str | os.PathLike, pixels: np.ndarray) -> None:
    """Write float pixels (linear Rec.709) as an EXR file: (H, W, 4) as premultiplied RGBA, (H, W, 3) as RGB, (H, W) as Y.

    The file has ZIP compression and scan lines. Raises OSError if the disk is full or the file cannot be written.
    """
    pixels = np.ascontiguousarray(pixels, np.float32)
    name = "Y" if pixels.ndim == 2 else {3: "RGB", 4: "RGBA"}[pixels.shape[2]]
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": REC709,
    }
    with whole(path) as temporary:
        try:
            OpenEXR.File(header, {name: pixels}).write(str(temporary))
        except RuntimeError as error:  # the binding reports a full disk by its text alone: find its code
            code = next((code for code in errno.errorcode if os.strerror(code) in str(error)), None)
            if code is None:
                raise
            raise OSError(code, os.strerror(code), str(path)) from None


def read_exr_header(path: str | os.PathLike) -> tuple[int, int, bool]:
    """Read an EXR file's width, its height, and whether it has alpha. No pixels are decoded.

    If the file has several parts, the three values are those of the part that `read_exr` reads. Raises InputError if the file is missing or
    broken, or if its data window differs from its display window (a crop or overscan).
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} is missing")
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            headers = [part.header for part in file.parts]
            _check_flat(path, headers)
            names = [{channel.name for channel in header["channels"]} for header in headers]
            part = next((i for i, found in enumerate(names) if set("RGB") <= found), 0)
            data, display = (np.array(headers[part][name]) for name in ("dataWindow", "displayWindow"))
    except InputError:
        raise
    except Exception:
        raise _broken(path) from None
    if not np.array_equal(data, display):
        raise InputError(f"{path} holds a part of the picture: save it without a crop or overscan")
    width, height = (data[1] - data[0] + 1).tolist()
    check_pixels(path, width, height, *_FEWEST)
    return width, height, "A" in names[part]


def read_exr(path: str | os.PathLike, is_data: bool = False) -> np.ndarray:
    """Read an EXR file as float32: (H, W, 4) for RGBA, (H, W, 3) for RGB, or (H, W) for a single channel.

    Colours are linear Rec.709: they are converted from the file's chromaticities. With `is_data`, as for normals, they stay as stored.

    If the file has several parts, the first part with R, G and B is read. If no part has them, the first part is read. Raises InputError if
    the file is missing or broken, or if the part has neither R, G and B nor exactly one channel.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} is missing")
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            headers = [dict(part.header) for part in file.parts]  # closing the file empties them
            _check_flat(path, headers)
            windows = [np.array(header["dataWindow"]) for header in headers]
        for low, high in windows:  # every part is decoded
            width, height = (high - low + 1).tolist()
            check_pixels(path, width, height, *_FEWEST)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            parts = [file.channels(i) for i in range(len(file.parts))]
            number = next((i for i, part in enumerate(parts) if {"R", "G", "B"} <= part.keys()), 0)
            channels = {name: channel.pixels for name, channel in parts[number].items()}
            primaries = np.array(headers[number].get("chromaticities", REC709), np.float64)
    except (InputError, MemoryError):
        raise
    except Exception:  # the binding raises RuntimeError, ValueError or its own errors
        raise _broken(path) from None
    if len({values.shape for values in channels.values()}) > 1:
        raise InputError(f"{path} has channels of several sizes: save all at the full size")
    if {"R", "G", "B"} <= channels.keys():
        names = [name for name in "RGBA" if name in channels]
        # No second copy: a panorama of 8192×4096 takes 400 MB.
        pixels = np.stack([channels[name] for name in names], axis=-1, dtype=np.float32, casting="unsafe")
        return pixels if is_data else _as_rec709(path, pixels, primaries)
    if len(channels) == 1:
        return next(iter(channels.values())).astype(np.float32)
    raise InputError(
        f"{path} has the channels {', '.join(sorted(channels))}: save it as plain RGB, RGBA or one channel"
    )


def _as_rec709(path: Path, pixels: np.ndarray, primaries: np.ndarray) -> np.ndarray:
    """Convert linear pixels from the chromaticities `primaries` to Rec.709 in place. Raises InputError."""
    if primaries.shape == np.shape(REC709) and np.allclose(primaries, REC709, atol=1e-3):
        return pixels
    try:
        matrix = primaries_to_rec709(primaries.tolist()).astype(np.float32)
    except ValueError:
        raise InputError(f"{path}: its chromaticities span no colours. Save it as linear Rec.709.") from None
    for row in pixels:
        row[:, :3] = row[:, :3] @ matrix.T
    return pixels


def _check_flat(path: Path, headers: list[dict]) -> None:
    """Raise InputError if a file is a deep EXR."""
    if any(header["type"] in (OpenEXR.deepscanline, OpenEXR.deeptile) for header in headers):
        raise InputError(f"{path} is a deep EXR: save it flattened, with one value a pixel")


def _broken(path: Path) -> InputError:
    return InputError(f"{path} is not a whole OpenEXR file: write or copy it again")
