"""Refuse pictures by the size that they declare, before memory is taken for their pixels."""

from pathlib import Path

from refgs.errors import InputError

MOST = 256_000_000  # pixels; cameras take up to 200 million, or 240 by shifting the sensor. Decoding takes 7 bytes or more a pixel
# A larger picture in a file so small that this many pixels share a byte is taken for a broken one. A PNG of one colour has 1032 to 8256, by
# deflate's limit, and a JPEG at most 341.
SMALL, MOST_PER_BYTE = 100_000_000, 10_000
PHOTO_PER_BYTE = 50  # the same for photos, which are not of one colour as masks are; those of phones have at most 10
MOST_SCANS = 100  # of a JPEG; progressive ones have about ten. Each is decoded in the time of a whole picture


def check_pixels(path: Path, width: int, height: int, small: int = SMALL, per_byte: int = MOST_PER_BYTE) -> None:
    """Raise InputError if a picture's file declares more than MOST pixels, or more pixels than the file can hold.

    The file is taken to hold at most `per_byte` pixels for each of its bytes, or `small` pixels if that is more.
    """
    size = f"{path}: {width}×{height} pixels"
    if width * height > MOST:
        raise InputError(f"{size} are more than the {MOST // 1_000_000} million that are read. Save it smaller.")
    if width * height > max(small, per_byte * path.stat().st_size):
        raise InputError(f"{size} do not fit into so small a file: it is broken. Replace it, or save it as PNG.")


def check_photo(path: Path, width: int, height: int) -> None:
    """Raise InputError if decoding a file would take far more memory or time than a real photo with as many bytes.

    `width` and `height` are the picture's declared size in pixels. Do not check masks with this function: a mask may be of one colour, so
    that many pixels fit into few bytes.
    """
    check_pixels(path, width, height, per_byte=PHOTO_PER_BYTE)
    with open(path, "rb") as file:
        if (
            file.read(2) == b"\xff\xd8" and file.read().count(b"\xff\xda") > MOST_SCANS
        ):  # start of scan (ITU-T T.81, B.1.1.3)
            raise InputError(
                f"{path}: this JPEG has more than {MOST_SCANS} scans, which takes too long to read. Save it anew."
            )


def check_chunks(path: Path) -> None:
    """Raise InputError if a PNG declares more bytes than it has: OpenCV would allocate as many as declared. Other formats are not checked.

    A PNG is 8 bytes and then chunks: a length, a name, that many bytes of data, and a checksum (PNG specification, 5.3).
    """
    size = path.stat().st_size
    with open(path, "rb") as file:
        if file.read(8) != b"\x89PNG\r\n\x1a\n":
            return
        name = b""
        while name != b"IEND" and len(head := file.read(8)) == 8:
            length, name = int.from_bytes(head[:4], "big"), head[4:]
            if file.tell() + length > size:
                raise InputError(f"{path}: the image is truncated or broken. Replace it.")
            file.seek(length + 4, 1)
