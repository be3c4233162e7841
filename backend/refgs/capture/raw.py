"""Read camera RAW photos with LibRaw: linear radiance in Rec.709, with the white balance that the camera chose."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rawpy
from PIL import ExifTags, Image

from refgs.errors import InputError
from refgs.paths import check_file, open_file

SUFFIXES = (
    ".dng",
    ".cr2",
    ".cr3",
    ".crw",
    ".nef",
    ".nrw",
    ".arw",
    ".raf",
    ".orf",
    ".rw2",
    ".pef",
    ".srw",
    ".3fr",
    ".iiq",
    ".rwl",
)
WHITE = 65535  # the value of a saturated sensor
# Sensors saturate a little below the level that the file names, and interpolation between their pixels rounds.
SATURATED = 0.98
_TURNS = {3: 2, 5: 3, 6: 1}  # clockwise quarter turns that make a photo upright, by LibRaw's `flip`


def read_raw_header(path: Path) -> tuple[int, int, int]:
    """Return a RAW photo's stored width and height and clockwise quarter turns. Raises InputError."""
    with _reading(path), rawpy.RawPy() as raw:
        raw.open_file(str(path))
        return raw.sizes.iwidth, raw.sizes.iheight, _TURNS.get(raw.sizes.flip, 0)


def read_raw(path: Path, half: bool = False) -> np.ndarray:
    """Read a RAW photo as linear radiance (H, W, 3) uint16, not turned upright. A value is WHITE where the sensor is saturated.

    With `half`, a square of 2×2 sensor pixels makes one pixel of the result, so that no colour needs to be interpolated. All photos of a
    camera have the same scale: a pixel's value depends on its light and the exposure, not on the other pixels. Raises InputError naming
    the file.
    """
    with _reading(path), rawpy.imread(str(path)) as raw:
        linear = raw.postprocess(
            use_camera_wb=True,
            no_auto_bright=True,
            adjust_maximum_thr=0,  # else LibRaw takes a photo's brightest pixel for white
            gamma=(1, 1),
            output_bps=16,
            user_flip=0,
            half_size=half,
        )
    linear = linear.reshape(*linear.shape[:2], -1)
    linear = np.repeat(linear, 3, axis=2) if linear.shape[2] == 1 else linear
    linear[linear >= SATURATED * WHITE] = WHITE
    return linear


def read_exif(path: Path) -> dict[int, Any]:
    """Read a RAW photo's EXIF tags. Raises an exception of any type without EXIF."""
    exif = Image.Exif()
    try:
        with open_file(path) as file:
            exif.load_from_fp(file)  # most formats are TIFF
            return exif.get_ifd(ExifTags.IFD.Exif)
    except Exception:
        with rawpy.imread(str(path)) as raw, Image.open(io.BytesIO(bytes(raw.extract_thumb().data))) as preview:
            return Image.Image.getexif(preview).get_ifd(ExifTags.IFD.Exif)


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn LibRaw's errors into an InputError that names the file."""
    if not path.is_file():
        raise InputError(f"{path}: the image is missing. Put it back, or remove it from the capture.")
    try:
        check_file(path)
        yield
    except OSError as error:
        raise InputError(f"{path}: the RAW photo is truncated or broken ({error.strerror}). Copy it again.") from error
    except (rawpy.LibRawFileUnsupportedError, rawpy.LibRawNotImplementedError, rawpy.NotSupportedError) as error:
        raise InputError(
            f"{path}: LibRaw does not know this camera's RAW, or the file is broken. Copy it again, or save it as DNG or 16-bit TIFF."
        ) from error
    except rawpy.LibRawUnsufficientMemoryError as error:  # which a broken file's numbers bring about, too
        raise InputError(
            f"{path}: LibRaw finds too little memory for the RAW photo. Close other programs, or copy it again if it is broken."
        ) from error
    except rawpy.LibRawError as error:
        said = error.args[0] if error.args else type(error).__name__
        said = said.decode() if isinstance(said, bytes) else said
        raise InputError(f"{path}: the RAW photo is truncated or broken ({said}). Copy it again.") from error
