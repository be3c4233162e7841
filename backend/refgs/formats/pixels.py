"""Refuse picture files that declare too many pixels, before memory is taken for them. Decode PNG, TIFF and Radiance pictures by OpenCV."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import Image

from refgs.errors import InputError
from refgs.paths import LARGEST, check_file, open_file

PNG = b"\x89PNG\r\n\x1a\n"  # its first bytes
# First bytes of what OpenCV is given: PNG, TIFF of either endianness, Radiance. By these it chooses the decoder, whatever a file's name.
_DECODED = (PNG, b"II*\0", b"MM\0*", b"#?RADIANCE", b"#?RGBE")

MOST = 256_000_000  # pixels; cameras take up to 200 million, or 240 by shifting the sensor
# A larger picture in a file so small that this many pixels share a byte is taken for a broken one. A PNG of one colour has 1032 to 8256, by
# deflate's limit, and a JPEG at most 341.
SMALL, MOST_PER_BYTE = 100_000_000, 10_000
# A photo of so many pixels is decoded in 1 GB: a pixel takes 8 bytes, or 16 with 16 bits a channel. Photos of more are read if they are
# as large as photos are: the flattest has 20 pixels a byte. Masks, which take less memory, are not bound by this.
PHOTO, DEEP_PHOTO, MOST_OF_PHOTO = 130_000_000, 65_000_000, 64
LONGEST = 512 << 20  # bytes of a photo in a file that is read as a whole
_SEGMENT = re.compile(rb"\xff([^\x00\x01\xd0-\xd8\xff])")
SCANS = 100  # of a JPEG; cameras write 1, and programs 10 of a progressive one. Each takes as long as decoding the photo once


def check_pixels(path: Path, width: int, height: int, small: int = SMALL, per_byte: int = MOST_PER_BYTE) -> None:
    """Raise InputError if a picture's file declares more pixels than a limit.

    The limit is `per_byte` pixels for each byte of the file, but at least `small` and at most MOST.
    """
    size = f"{path}: {width}×{height} pixels"
    if width * height > MOST:
        raise InputError(f"{size} are more than the {MOST // 1_000_000} million that are read. Save it smaller.")
    if width * height > max(small, per_byte * path.stat().st_size):
        raise InputError(f"{size} do not fit into so small a file: it is broken. Replace it, or save it as PNG.")


def check_length(path: Path) -> None:
    """Check the file of a photo before Pillow opens it.

    Raises OSError if the file is empty, or not an ordinary file. Raises ValueError for a WebP, HEIC or AVIF file of more than LONGEST
    bytes, because Pillow would read the whole file into memory.
    """
    check_file(path)
    if path.stat().st_size > LONGEST:
        with open_file(path) as file:
            if (head := file.read(8))[:4] == b"RIFF" or head[4:] == b"ftyp":
                raise ValueError("larger than such a photo can be")


def check_chunks(path: Path) -> None:
    """Raise InputError if a PNG's chunk declares more bytes than the file has."""
    size = path.stat().st_size
    with open_file(path) as file:
        for _, length in png_chunks(file):
            if file.tell() + length > size:
                raise InputError(f"{path}: the image is truncated or broken. Replace it.")


def png_chunks(file: BinaryIO) -> Iterator[tuple[bytes, int]]:
    """Yield the name and the declared length of each chunk of a PNG. When it yields, `file` is at the chunk's data.

    Nothing is yielded for other formats. A PNG is 8 bytes and then chunks. A chunk has a length, a name, that many bytes of data, and a
    checksum (PNG specification, 5.3).
    """
    if file.read(8) != PNG:
        return
    name = b""
    while name != b"IEND" and len(head := file.read(8)) == 8:
        length, name, start = int.from_bytes(head[:4], "big"), head[4:], file.tell()
        yield name, length
        file.seek(start + length + 4)


def check_scans(path: Path, width: int, height: int) -> None:
    """Raise InputError if a JPEG has more than SCANS scans, because it would take minutes to decode.

    Scans are counted by their markers (ITU-T T.81, annex B). A marker is 0xFF and a code byte. Compressed pixels are not mistaken for such
    a marker: in them, only 0 or the code of a restart marker follows 0xFF. At most 8 · `width` · `height` + LARGEST bytes of the file are
    searched.
    """
    with open_file(path) as file:
        data = file.read(min(8 * width * height + LARGEST, LONGEST))
    count, at = 0, 2
    while (found := _SEGMENT.search(data, at)) and found[1] != b"\xd9":  # the end
        count += found[1] == b"\xda"
        at = found.end() + int.from_bytes(data[found.end() : found.end() + 2], "big")
    if count > SCANS:
        raise InputError(f"{path}: the JPEG has more than {SCANS} scans, which take too long to decode. Save it again.")


def read_png(path: Path, flags: int = -1) -> np.ndarray | None:
    """Read a run's PNG as `cv2.imread` does, None if it cannot be used."""
    try:
        check_file(path)
        with Image.open(path, formats=("PNG",)) as picture:
            size = picture.size
            check_pixels(path, *size)
        check_chunks(path)
        return decode(path, flags, *size)
    except Exception:  # Pillow's have no common class
        return None


def decode(path: Path, flags: int, width: int, height: int) -> np.ndarray | None:
    """Decode a PNG, TIFF or Radiance picture as `cv2.imread` does with these `flags`. Return None if it is broken or of another format.

    `width` and `height` are the size in the picture's header. Raises OSError if the file cannot be read. Raises InputError if the file has
    far more bytes than a picture of this size can take.

    Other formats are not given to OpenCV, because nobody needs them here and their decoders are a risk: the JPEG 2000 decoder of OpenCV
    4.11 writes out of bounds (CVE-2025-53644).
    """
    import cv2  # here, because most lights are EXR

    with open_file(path) as file:
        if not file.read(16).startswith(_DECODED):
            return None
        # A pixel takes 16 bytes at most. Twice that and some megabytes leave room for previews and metadata.
        if path.stat().st_size > 32 * width * height + LARGEST:
            raise InputError(f"{path} is larger than its {width}×{height} pixels can be. Save it again.")
        file.seek(0)
        data = np.frombuffer(file.read(), np.uint8)
    try:
        return cv2.imdecode(data, flags)
    except cv2.error:
        return None
