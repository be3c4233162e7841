"""Refuse pictures by the size that they declare, before memory is taken for their pixels. Decode some by OpenCV."""

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
    """Raise InputError if a picture's file declares more than MOST pixels, or more pixels than the file can hold.

    The file is taken to hold at most `per_byte` pixels for each of its bytes, or `small` pixels if that is more.
    """
    size = f"{path}: {width}×{height} pixels"
    if width * height > MOST:
        raise InputError(f"{size} are more than the {MOST // 1_000_000} million that are read. Save it smaller.")
    if width * height > max(small, per_byte * path.stat().st_size):
        raise InputError(f"{size} do not fit into so small a file: it is broken. Replace it, or save it as PNG.")


def check_length(path: Path) -> None:
    """Check the file of a photo before Pillow opens it. Raises OSError if it is no ordinary file, or empty.

    Raises ValueError for a WebP, HEIC or AVIF of more than LONGEST bytes: these are read as a whole.
    """
    check_file(path)
    if path.stat().st_size > LONGEST:
        with open_file(path) as file:
            if (head := file.read(8))[:4] == b"RIFF" or head[4:] == b"ftyp":
                raise ValueError("larger than such a photo can be")


def check_chunks(path: Path) -> None:
    """Raise InputError if a PNG declares more bytes than it has: OpenCV would allocate as many. Other formats are not checked."""
    size = path.stat().st_size
    with open_file(path) as file:
        for _, length in png_chunks(file):
            if file.tell() + length > size:
                raise InputError(f"{path}: the image is truncated or broken. Replace it.")


def png_chunks(file: BinaryIO) -> Iterator[tuple[bytes, int]]:
    """Yield the name and the declared length of each chunk of a PNG, with `file` at the chunk's data. Yield none for other files.

    A PNG is 8 bytes and then chunks: a length, a name, that many bytes of data, and a checksum (PNG specification, 5.3).
    """
    if file.read(8) != PNG:
        return
    name = b""
    while name != b"IEND" and len(head := file.read(8)) == 8:
        length, name, start = int.from_bytes(head[:4], "big"), head[4:], file.tell()
        yield name, length
        file.seek(start + length + 4)


def check_scans(path: Path, width: int, height: int) -> None:
    """Raise InputError if a JPEG has more than SCANS scans, by which a small file would be decoded for minutes.

    A segment is 0xFF, a letter, its length, and that many bytes less two. In the pixels' code after it, 0xFF stands only before 0 and the
    letters of restarts (ITU-T T.81, annex B).
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
    """Read a PNG of a run as `cv2.imread` does. Return None if it is missing, broken, too large, or no PNG."""
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
    """Decode a PNG, TIFF or Radiance picture as `cv2.imread` does. Return None if it is broken or another kind of picture.

    `width` and `height` are what its header says. OpenCV would read many more kinds, by decoders that nobody needs here. That of JPEG 2000
    in 4.11 writes out of bounds (CVE-2025-53644). Raises OSError if the file cannot be read, and InputError if it is far larger than its
    pixels can be.
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
