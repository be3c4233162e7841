"""Write camera RAW photos: uncompressed DNG with an RGGB sensor."""

import struct
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

BLACK, WHITE = 512, 16383  # of the sensor
# From XYZ to linear Rec.709 (IEC 61966-2-1): the colours of a camera that sees as sRGB does.
_MATRIX = [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]


def write_dng(
    path: Path, linear: np.ndarray, neutral: ArrayLike = (0.5, 1, 0.7), turns: int = 0, film: int = 0
) -> None:
    """Write linear Rec.709 radiance (H, W, 3) as a camera would, of which 1 saturates the sensor's green.

    `neutral` is what the sensor sees of white, for the white balance. EXIF says that `turns` clockwise quarter turns make the photo
    upright, and the focal length for 35 mm film in mm. As in a camera, only one colour is kept of each pixel.
    """
    stored = np.rot90(linear, turns) * neutral
    sensor = np.empty(stored.shape[:2])
    for y, x, channel in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        sensor[y::2, x::2] = stored[y::2, x::2, channel]
    values = np.rint(BLACK + sensor * (WHITE - BLACK)).clip(0, WHITE).astype(np.uint16)

    def fractions(numbers: ArrayLike) -> list[int]:
        return [n for number in np.ravel(numbers) for n in (round(number * 10000), 10000)]

    height, width = values.shape
    exif, directory, pixels = 8, 26, 1024  # places in the file
    tags = [  # number, type, values; in the order of TIFF
        (254, "I", [0]),  # NewSubfileType: the photo itself
        (256, "I", [width]),
        (257, "I", [height]),
        (258, "H", [16]),  # BitsPerSample
        (259, "H", [1]),  # Compression: none
        (262, "H", [32803]),  # PhotometricInterpretation: colour filters
        (273, "I", [pixels]),  # StripOffsets
        (274, "H", [(1, 6, 3, 8)[turns]]),  # Orientation
        (277, "H", [1]),  # SamplesPerPixel
        (278, "I", [height]),  # RowsPerStrip
        (279, "I", [values.nbytes]),
        (33421, "H", [2, 2]),  # CFARepeatPatternDim
        (33422, "B", [0, 1, 1, 2]),  # CFAPattern
        (34665, "I", [exif]),
        (50706, "B", [1, 4, 0, 0]),  # DNGVersion
        (50708, "s", b"Sensor\0"),  # UniqueCameraModel
        (50714, "I", [BLACK]),
        (50717, "I", [WHITE]),
        (50721, "2i", fractions(_MATRIX)),  # ColorMatrix1
        (50728, "2I", fractions(neutral)),  # AsShotNeutral
        (50778, "H", [21]),  # CalibrationIlluminant1: D65
    ]
    behind, entries, more = directory + 2 + 12 * len(tags) + 4, b"", b""
    for number, kind, numbers in tags:
        data = numbers if kind == "s" else struct.pack(f"<{len(numbers)}{kind[-1]}", *numbers)
        count, code = (
            len(numbers) // (2 if kind[0] == "2" else 1),
            {"B": 1, "s": 2, "H": 3, "I": 4, "2I": 5, "2i": 10}[kind],
        )
        value = data.ljust(4, b"\0") if len(data) <= 4 else struct.pack("<I", behind + len(more))
        more += data if len(data) > 4 else b""
        entries += struct.pack("<HHI", number, code, count) + value
    path.parent.mkdir(parents=True, exist_ok=True)
    about = struct.pack("<HHHIII", 1, 41989, 3, 1, film, 0)  # EXIF: FocalLengthIn35mmFilm
    header = (
        struct.pack("<2sHI", b"II", 42, directory) + about + struct.pack("<H", len(tags)) + entries + bytes(4) + more
    )
    path.write_bytes(header.ljust(pixels, b"\0") + values.tobytes())
