"""Read and write OpenEXR pictures."""

import errno
import os
from pathlib import Path

import numpy as np
import OpenEXR

from refgs.errors import InputError
from refgs.formats.pixels import check_pixels
from refgs.paths import whole

# Chromaticities x, y of Rec.709 / sRGB: red, green, blue, D65 white (ITU-R BT.709-6, table 1).
_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)

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
        "chromaticities": _REC709,
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
    """Read the width, the height, and whether there is alpha, of the part that `read_exr` reads. No pixels are decoded.

    Raises InputError if the file is missing or broken, or if it holds less or more than the whole picture.
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


def read_exr(path: str | os.PathLike) -> np.ndarray:
    """Read an EXR file as float32: (H, W, 4) for RGBA, (H, W, 3) for RGB, or (H, W) for a single channel.

    If the file has several parts, the first part with R, G and B is read. If no part has them, the first part is read. Without R, G and B
    the part must have one channel. Raises InputError if it does not, or if the file is missing or broken.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} is missing")
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            headers = [part.header for part in file.parts]
            _check_flat(path, headers)
            windows = [np.array(header["dataWindow"]) for header in headers]
        for low, high in windows:  # every part is decoded
            width, height = (high - low + 1).tolist()
            check_pixels(path, width, height, *_FEWEST)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            parts = [file.channels(i) for i in range(len(file.parts))]
            part = next((part for part in parts if {"R", "G", "B"} <= part.keys()), parts[0])
            channels = {name: channel.pixels for name, channel in part.items()}
    except (InputError, MemoryError):
        raise
    except Exception:  # the binding raises RuntimeError, ValueError or its own errors
        raise _broken(path) from None
    if len({values.shape for values in channels.values()}) > 1:
        raise InputError(f"{path} has channels of several sizes: save all at the full size")
    if {"R", "G", "B"} <= channels.keys():
        names = [name for name in "RGBA" if name in channels]
        # No second copy: a panorama of 8192×4096 takes 400 MB.
        return np.stack([channels[name] for name in names], axis=-1, dtype=np.float32, casting="unsafe")
    if len(channels) == 1:
        return next(iter(channels.values())).astype(np.float32)
    raise InputError(
        f"{path} has the channels {', '.join(sorted(channels))}: save it as plain RGB, RGBA or one channel"
    )


def _check_flat(path: Path, headers: list[dict]) -> None:
    """Raise InputError if a part of the file is deep: such a pixel has a list of samples."""
    if any(header["type"] in (OpenEXR.deepscanline, OpenEXR.deeptile) for header in headers):
        raise InputError(f"{path} is a deep picture, with several samples a pixel: save it flattened")


def _broken(path: Path) -> InputError:
    return InputError(f"{path} is not a whole OpenEXR file: write or copy it again")
