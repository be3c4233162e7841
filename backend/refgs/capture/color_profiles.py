"""Convert a photo's codes (encoded pixel values) from the colour space that its file declares to sRGB, which has Rec.709 primaries.

A file declares its colours by an ICC profile, by code points of ITU-T H.273 (PNG's cICP, nclx of HEIC and AVIF), by PNG's gAMA and cHRM,
or by the EXIF of a camera that is set to Adobe RGB. Colours beyond Rec.709 are clipped.
"""

import struct
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from io import BytesIO
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from PIL import ExifTags, Image, ImageCms

from refgs.capture.reduce import encode
from refgs.color import REC709, pcs_to_rec709, primaries_to_rec709, srgb_decode, srgb_encode
from refgs.errors import InputWarning, reason
from refgs.formats.pixels import png_chunks
from refgs.paths import open_file

Found = TypeVar("Found", bound="Profile | LookUp | None")
Curve = Callable[[np.ndarray], np.ndarray]  # from codes 0..1 to linear values

# White's 16-bit code in photos that may be brighter: 16 steps a step of 8 bits. The largest code is 694 times as bright as white.
HDR_WHITE = 4080

STRIP = 1 << 18  # pixels that are converted at a time, about

# How far a profile may be from sRGB and still count as it: each channel's curve in codes of 255, and the matrix. Files of sRGB differ by
# rounding. The nearest other spaces are a gamma of 2.2, which differs by 7 codes, and PAL's primaries, by 0.04.
SAME_CODE, SAME_MATRIX = 1.0, 0.005

_D65 = (0.3127, 0.3290)
# Chromaticities of red, green, blue and white by H.273's code points (table 2). 2 is unspecified.
_PRIMARIES = {
    1: REC709,
    2: REC709,
    4: (0.67, 0.33, 0.21, 0.71, 0.14, 0.08, 0.310, 0.316),
    5: (0.64, 0.33, 0.29, 0.60, 0.15, 0.06, *_D65),
    6: (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, *_D65),
    7: (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, *_D65),
    9: (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *_D65),
    11: (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.314, 0.351),
    12: (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *_D65),
    22: (0.630, 0.340, 0.295, 0.605, 0.155, 0.077, *_D65),
}
_ADOBE_RGB = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06)  # primaries; its gamma is 563/256


def _pq(codes: np.ndarray) -> np.ndarray:
    """Decode PQ codes in 0..1 (SMPTE ST 2084) to radiance, where 1 is 203 cd/m²."""
    root = codes ** (32 / 2523)
    return 10_000 / 203 * (np.maximum(root - 107 / 128, 0) / (2413 / 128 - 2392 / 128 * root)) ** (16384 / 2610)


def _hlg(codes: np.ndarray) -> np.ndarray:
    """Decode HLG codes in 0..1 (ITU-R BT.2100) to scene radiance, where code 0.75 gives 1."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073

    def scene(codes):
        return np.where(codes <= 0.5, codes**2 / 3, (np.exp((codes - c) / a) + b) / 12)

    return scene(codes) / scene(0.75)


def _power(gamma: float) -> Curve:
    return lambda codes: codes**gamma


# Curves by H.273's code points (table 3). Where a photo's file names a video's curve (1, 6, 14, 15), its codes are taken for those of sRGB,
# as browsers do. 2 is unspecified.
_TRANSFERS: dict[int, Curve] = {
    **dict.fromkeys((1, 2, 6, 13, 14, 15), srgb_decode),
    4: _power(2.2),
    5: _power(2.8),
    8: _power(1.0),
    16: _pq,
    18: _hlg,
}
_HDR = (16, 18)


class Unusable(Exception):
    """Error for a colour profile that cannot be used. Its message says why."""


@dataclass(frozen=True, eq=False)
class Profile:
    """Hold a colour profile: a curve for each channel, then a matrix (3, 3) to linear Rec.709.

    A curve maps codes in 0..1 to linear values. With `hdr`, radiance may exceed that of white. With `grey`, the profile is for greyscale
    pictures.
    """

    curves: tuple[Curve, ...]
    matrix: np.ndarray
    hdr: bool = False
    grey: bool = False

    @cached_property
    def is_srgb(self) -> bool:
        """Tell whether the profile is nearly sRGB, so that codes need no conversion."""
        differences = srgb_encode(_table(self, 256)) - np.linspace(0, 1, 256)[:, None]
        return bool(np.abs(self.matrix - np.eye(3)).max() < SAME_MATRIX and np.abs(differences).max() < SAME_CODE / 255)

    def to_srgb(self, image: np.ndarray) -> tuple[np.ndarray, int]:
        """Convert codes (H, W, 3), uint8 or uint16, to sRGB codes. Return these and the code of white. `image` is overwritten.

        The result has the dtype of `image`, or uint16 if `hdr` is true.
        """
        largest = np.iinfo(image.dtype).max
        table, matrix = _table(self, largest + 1), self.matrix.astype(np.float32)
        white = HDR_WHITE if self.hdr else largest
        out = np.empty(image.shape, np.uint16) if self.hdr else image
        step = max(1, STRIP // image.shape[1])
        for top in range(0, len(image), step):
            part = image[top : top + step]
            linear = cv2.LUT(part, table[None]) if largest == 255 else table[part, (0, 1, 2)]
            if white == 255:  # by a table, because a power takes ten times as long
                linear = cv2.transform(linear, matrix * 65535)
                # It rounds and clips.
                steps = np.asarray(cv2.addWeighted(linear, 1, linear, 0, 0, dtype=cv2.CV_16U), np.uint16)
                np.take(_bytes(), steps, out=out[top : top + step], mode="clip")
            else:
                out[top : top + step] = encode(cv2.transform(linear, matrix), white)
        return out, white


@dataclass(frozen=True, eq=False)
class LookUp:
    """Hold a table-based colour profile for 8-bit pictures of Pillow's mode `mode`, such as CMYK."""

    profile: ImageCms.ImageCmsProfile
    mode: str

    def to_srgb(self, picture: Image.Image) -> Image.Image:
        """Convert a picture of the mode `mode`, or RGBA, to 8-bit sRGB. Alpha stays."""
        out = "RGBA" if picture.mode == "RGBA" else "RGB"
        return _transform(self, picture.mode, out).apply(picture)


def declared_profile(picture: Image.Image, path: Path) -> Profile | LookUp | None:
    """Return the profile of an opened picture's colours. Return None if the file declares none, or sRGB.

    Also return None for a profile that cannot be used. An InputWarning says why, once for each reason.
    """
    return _usable(lambda: _of_picture(picture, path), path)


def coded_profile(primaries: int, transfer: int, path: Path) -> Profile | None:
    """Return the profile for two code points of H.273, one of colour primaries and one of a transfer curve. Return None if it is sRGB.

    Also return None for unknown code points. An InputWarning then names the file `path`, once for each reason.
    """
    return _usable(lambda: _of_code_points(primaries, transfer), path)


def _usable(find: Callable[[], Found], path: Path) -> Found | None:
    """Return what `find` returns, but None for sRGB and, with a warning, for Unusable."""
    try:
        found = find()
    except Unusable as error:
        _warn_once(str(error), path)
        return None
    return None if isinstance(found, Profile) and found.is_srgb else found


def _of_picture(picture: Image.Image, path: Path) -> Profile | LookUp | None:
    if not (data := picture.info.get("icc_profile")):
        return _of_tags(picture, path)
    found = _of_icc(data)
    _check_mode(found, picture.mode)
    return found


def _of_tags(picture: Image.Image, path: Path) -> Profile | None:
    """Return the profile of a picture's non-ICC tags, or None. Raises Unusable."""
    info = picture.info
    if picture.format == "PNG":
        if points := _png_code_points(path):
            return _of_code_points(*points)
        if "srgb" in info or not info.keys() & {"gamma", "chromaticity"}:
            return None
        return _of_gamma(info.get("gamma"), info.get("chromaticity"))
    if picture.format == "HEIF" and (nclx := info.get("nclx_profile")):
        return _of_code_points(nclx["color_primaries"], nclx["transfer_characteristics"])
    if picture.format == "AVIF" and (points := _avif_code_points(path)):
        return _of_code_points(*points)
    if picture.format in ("JPEG", "MPO", "TIFF") and _is_adobe_rgb(picture):
        return _of_gamma(256 / 563, (*_D65, *_ADOBE_RGB))
    return None


@lru_cache(32)
def _of_code_points(primaries: int, transfer: int) -> Profile:
    if primaries not in _PRIMARIES or transfer not in _TRANSFERS:
        raise Unusable(f"the code points {primaries} and {transfer} are not known")
    return Profile((_TRANSFERS[transfer],) * 3, primaries_to_rec709(_PRIMARIES[primaries]), transfer in _HDR)


@lru_cache(32)
def _of_gamma(gamma: float | None, chromaticities: tuple[float, ...] | None) -> Profile:
    """Return the profile of a PNG's gAMA and cHRM, sRGB's if None. Raises Unusable."""
    # The PNG specification lets encoders write a gamma of 0.45455 for sRGB's curve.
    curve = srgb_decode if not gamma or abs(gamma - 0.45455) < 5e-5 else _power(1 / gamma)  # Adobe RGB has 0.45471
    white, primaries = (chromaticities[:2], chromaticities[2:]) if chromaticities else ((), ())
    try:
        return Profile((curve,) * 3, primaries_to_rec709([*primaries, *white] or REC709))
    except ValueError as error:
        raise Unusable("its primaries span no colours") from error


def _is_adobe_rgb(picture: Image.Image) -> bool:
    """Tell whether a picture's EXIF says Adobe RGB (DCF 2.0, 5.1)."""
    try:
        exif = Image.Image.getexif(picture)
        return exif.get_ifd(ExifTags.IFD.Interop).get(ExifTags.Interop.InteropIndex) == "R03"
    except Exception:  # broken EXIF: the pixels are still good
        return False


def _png_code_points(path: Path) -> tuple[int, int] | None:
    """Return the code points (primaries, transfer) of a PNG's chunk cICP, or None."""
    with open_file(path) as file:
        for name, _ in png_chunks(file):
            if name == b"cICP":
                points = file.read(2)
                return (points[0], points[1]) if len(points) == 2 else None
            if name == b"IDAT":
                break
    return None


def _avif_code_points(path: Path) -> tuple[int, int] | None:
    """Return the code points (primaries, transfer) of an AVIF's primary item, or None."""
    try:
        meta = next(body for kind, body in _boxes(path.read_bytes()) if kind == b"meta")[4:]
        inside = dict(_boxes(meta))
        wide = inside[b"pitm"][0] > 0
        primary = int.from_bytes(inside[b"pitm"][4 : 8 if wide else 6], "big")
        properties = dict(_boxes(inside[b"iprp"]))
        colors = {number: body for number, (kind, body) in enumerate(_boxes(properties[b"ipco"]), 1) if kind == b"colr"}
        for number in _associated(properties[b"ipma"], primary):
            if (body := colors.get(number, b""))[:4] == b"nclx":
                return struct.unpack(">HH", body[4:8])
    except (StopIteration, KeyError, IndexError, struct.error):  # no such boxes, or broken ones
        pass
    return None


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield each box's type (4 bytes) and contents (ISO/IEC 14496-12, 4.2)."""
    at = 0
    while at + 8 <= len(data):
        size, kind, start = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8], at + 8
        if size == 1:
            size, start = int.from_bytes(data[start : start + 8], "big"), start + 8
        end = at + size if size else len(data)
        if end < start:
            return
        yield kind, data[start:end]
        at = end


def _associated(ipma: bytes, item: int) -> list[int]:
    """Return an item's property numbers, from 1, in the box ipma (ISO/IEC 23008-12, 9.3.2)."""
    version, wide, count, at = ipma[0], ipma[3] & 1, int.from_bytes(ipma[4:8], "big"), 8
    for _ in range(count):
        size = 2 if version < 1 else 4
        number, entries, at = int.from_bytes(ipma[at : at + size], "big"), ipma[at + size], at + size + 1
        step = 2 if wide else 1
        found = [int.from_bytes(ipma[at + step * i : at + step * (i + 1)], "big") for i in range(entries)]
        if number == item:
            return [each & (0x7FFF if wide else 0x7F) for each in found]
        at += step * entries
    return []


def _of_icc(data: bytes) -> Profile | LookUp:
    """Parse an ICC profile to a LookUp if it is made of tables. Raises Unusable."""
    found = _parsed(data)
    if isinstance(found, str):
        raise Unusable(found)
    return found


@lru_cache(32)
def _parsed(data: bytes) -> Profile | LookUp | str:
    """Parse an ICC profile (ICC.1:2022). If it cannot be used, return the reason as text."""
    try:
        if data[36:40] != b"acsp":
            return "it is broken"
        entries = struct.iter_unpack(">4sII", data[132 : 132 + 12 * struct.unpack_from(">I", data, 128)[0]])
        tags = {name: data[start : start + size] for name, start, size in entries}
        if b"cicp" in tags and tags[b"cicp"][9] in _HDR:
            return _of_code_points(*tags[b"cicp"][8:10])
        space, tables = data[16:20], b"A2B0" in tags or b"A2B1" in tags
        if space == b"GRAY" and not tables:
            return Profile((_curve(tags[b"kTRC"]),) * 3, np.eye(3), grey=True)
        if space == b"RGB " and not tables:
            columns = [struct.unpack_from(">3i", tags[name], 8) for name in (b"rXYZ", b"gXYZ", b"bXYZ")]
            matrix = pcs_to_rec709() @ np.transpose(columns) / 65536
            if not 0.5 < matrix.sum(axis=1).min() <= matrix.sum(axis=1).max() < 2:
                return "it is broken: its white is no white"
            red, green, blue = (_curve(tags[name]) for name in (b"rTRC", b"gTRC", b"bTRC"))
            return Profile((red, green, blue), matrix)
        if space not in (b"RGB ", b"CMYK"):
            return f"its colour space is {space.decode('latin-1').strip()}"
        profile = LookUp(ImageCms.ImageCmsProfile(BytesIO(data)), space.decode().strip())
        _transform(profile, profile.mode, "RGB")
        return profile
    except (KeyError, IndexError, struct.error, ValueError, ArithmeticError) as error:
        return f"it is broken: {reason(error)}"
    except (OSError, ImageCms.PyCMSError, Unusable) as error:
        return reason(error)


def _curve(tag: bytes) -> Curve:
    """Return a profile's curve from a curv or para tag (ICC.1:2022, 10.6 and 10.18)."""
    kind = tag[:4]
    if kind == b"curv":
        count = struct.unpack_from(">I", tag, 8)[0]
        values = np.array(struct.unpack_from(f">{count}H", tag, 12))
        if count == 0:
            return _power(1.0)
        if count == 1:
            return _power(values[0] / 256)
        return lambda codes: np.interp(codes * (count - 1), np.arange(count), values / 65535)
    if kind != b"para":
        raise ValueError(f"unknown curve {kind!r}")
    form = struct.unpack_from(">H", tag, 8)[0]
    given = [number / 65536 for number in struct.unpack_from(f">{(1, 3, 4, 5, 7)[form]}i", tag, 12)]
    g, a, b, c, d, e, f = given + [0] * (7 - len(given))
    if form == 0:
        a, d = 1.0, -np.inf
    elif form in (1, 2):
        # Below −b/a these forms are constant: that is c in form 2.
        d, e, f, c = -b / a, c, c, 0.0
    return lambda codes: np.where(codes >= d, np.maximum(a * codes + b, 0) ** g + e, c * codes + f)


def _check_mode(profile: Profile | LookUp, mode: str) -> None:
    """Raise Unusable if a profile is not for pictures of this Pillow mode."""
    if isinstance(profile, Profile) and profile.grey:
        if mode[0] not in "1LI":
            raise Unusable("it is for greyscale pictures")
    elif (mode == "CMYK") != (isinstance(profile, LookUp) and profile.mode == "CMYK"):
        raise Unusable(f"it is not for {mode}")


@lru_cache(32)
def _table(profile: Profile, size: int) -> np.ndarray:
    """Return the linear values, float32 (size, 3), of all codes below `size`."""
    codes = np.arange(size) / (size - 1)
    with np.errstate(all="ignore"):  # a broken profile's numbers
        values = np.stack([curve(codes) for curve in profile.curves], axis=1)
    return np.nan_to_num(np.clip(values, 0, 100)).astype(np.float32)


@cache
def _bytes() -> np.ndarray:
    """Return a table from 16-bit linear values to 8-bit sRGB codes, uint8 (65536,)."""
    return encode(np.arange(65536) / 65535, 255)


@lru_cache(32)
def _transform(profile: LookUp, mode: str, out: str) -> ImageCms.ImageCmsTransform:
    relative, black = ImageCms.Intent.RELATIVE_COLORIMETRIC, ImageCms.Flags.BLACKPOINTCOMPENSATION
    return ImageCms.buildTransform(profile.profile, ImageCms.createProfile("sRGB"), mode, out, relative, black)


_told: set[str] = set()


def _warn_once(why: str, path: Path) -> None:
    if why not in _told:
        _told.add(why)
        text = f"{path}: its colour profile is ignored: {why}. Save such photos as sRGB if their colours look wrong."
        warnings.warn(InputWarning(text), stacklevel=4)
