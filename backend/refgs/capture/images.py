"""Load photos and masks for training: decode, undistort and reduce them. The results are sRGB codes (integers) with straight alpha.

Colours are those that the file declares: see `refgs.capture.color_profiles`. Photos with 8 bits a channel are loaded as 8-bit codes. Photos
with more bits (PNG and TIFF with 16, HEIC with 10, camera RAW, EXR) are loaded as 16-bit codes. In EXR and HDR photos, codes above that of
white stand for brighter radiance.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import tifffile
from PIL import ExifTags, Image, ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.TiffImagePlugin import BITSPERSAMPLE, EXTRASAMPLES, OPEN_INFO, PHOTOMETRIC_INTERPRETATION, PLANAR_CONFIGURATION
from pillow_heif import open_heif, register_heif_opener

from refgs.camera import Camera
from refgs.capture import raw
from refgs.capture.color_profiles import HDR_WHITE, LookUp, Profile, declared_profile
from refgs.capture.reduce import encode, reduced
from refgs.capture.types import View
from refgs.errors import InputError, reason
from refgs.formats.exr import read_exr, read_exr_header
from refgs.formats.pixels import (
    DEEP_PHOTO,
    MOST_OF_PHOTO,
    PHOTO,
    check_chunks,
    check_length,
    check_pixels,
    check_scans,
    decode,
)
from refgs.memory import is_shortage
from refgs.paths import open_file

register_heif_opener()  # Pillow opens HEIC then
# It lacks big-endian greyscale TIFF with 16 bits in which 0 is white. `_decode_16_bit` inverts what it reads.
OPEN_INFO[b"MM", 0, (1,), 1, (16,), ()] = ("I;16B", "I;16B")
Image.MAX_IMAGE_PIXELS = None  # `check_pixels` has the limit

# The JPEG decoder leaves a photo at least this many times as large as wanted. It averages encoded values, which darkens highlights: at 2,
# a photo differs by 0.6 of 255 on average from one reduced in linear light (49 dB); at 1, by 1.7 (41 dB).
SPARE = 2

# Pillow's names of what a photo's file may be, whatever its suffix. Of Pillow's other formats some start programs, as EPS does.
# With the suffixes by which photos are found in a folder; where a photo is there twice, the first is preferred.
FORMATS = {
    "PNG": (".png",),
    "JPEG": (".jpg", ".jpeg", ".jpe", ".jfif", ".mpo"),
    "HEIF": (".heic", ".heif", ".hif"),
    "TIFF": (".tif", ".tiff"),
    "WEBP": (".webp",),
    "BMP": (".bmp",),
    "AVIF": (".avif",),
    "JPEG2000": (".jp2", ".j2k", ".jpx"),
    "PPM": (".ppm", ".pgm", ".pbm", ".pnm"),
    "TGA": (".tga",),
    "GIF": (".gif",),
}

# Names of gain maps: Ultra HDR's in XMP, that of ISO 21496-1 in a segment APP2, Apple's in XMP and HEIC.
_GAIN_MAPS = (
    b"http://ns.adobe.com/hdr-gain-map/",
    b"urn:iso:std:iso:ts:21496:-1",
    b"urn:com:apple:photo:2020:aux:hdrgainmap",
)
_PICTURES = 4  # in a JPEG whose headers are read; phones write two or three

ROWS = 128  # that are copied from a decoded picture at a time

# Clockwise quarter turns that make a photo upright, by EXIF orientation. The mirrored orientations 2, 4, 5 and 7 are ignored: no camera
# sees a mirrored world.
_TURNS = {6: 1, 3: 2, 8: 3}


@dataclass(frozen=True, eq=False)
class LoadedView:
    """Hold the pixels of a photo for training: `image` (H, W, 3), sRGB-encoded, and `alpha` (H, W) uint8, None without a mask.

    `image` has the dtype uint8 or uint16, and `white` is the code of white in it. A pixel with the dtype's largest code is clipped: its
    true radiance may be higher. Colours are not premultiplied by alpha. `camera` is the pinhole camera for this image size. If the photo
    was reduced or undistorted, its fully transparent pixels are black.
    """

    image: np.ndarray
    alpha: np.ndarray | None
    camera: Camera
    white: int = 255

    @property
    def encoded(self) -> np.ndarray:
        """Return the sRGB-encoded photo, float32 (H, W, 3); 1 is white, HDR photos exceed it."""
        return self.image.astype(np.float32) / self.white

    @property
    def bytes(self) -> np.ndarray:
        """Return the photo as 8-bit sRGB (H, W, 3), clipped to white."""
        return as_bytes(self.image, self.white)

    @property
    def clipped(self) -> np.ndarray:
        """Mark the clipped or nearly clipped channels of all pixels, bool (H, W, 3)."""
        return self.image >= np.iinfo(self.image.dtype).max // 255 * 254


class Header(NamedTuple):
    """Hold facts from the header of an image file.

    `width` and `height` are the size of the stored image in pixels. `has_alpha` tells whether it has transparency. `turns` is the number of
    clockwise quarter turns that make it upright, by its EXIF.
    """

    width: int
    height: int
    has_alpha: bool
    turns: int

    @property
    def upright(self) -> tuple[int, int]:
        """Return the width and height of the upright image, as `read_image` returns it."""
        return (self.height, self.width) if self.turns % 2 else (self.width, self.height)


def read_header(path: Path) -> Header:
    """Read an image file's header. No pixels are decoded. Raises InputError naming the file."""
    if _is_raw(path):
        width, height, turns = raw.read_raw_header(path)
        return Header(width, height, False, turns)
    if _is_exr(path):
        return Header(*read_exr_header(path), 0)
    with _open(path) as picture:
        return Header(*picture.size, picture.has_transparency_data, _turns(picture))


def has_gain_map(path: Path) -> bool:
    """Tell whether a JPEG or HEIC holds a gain map, with which viewers make the photo brighter than white. No pixels are decoded.

    `read_image` does not use it. Raises InputError naming the file.
    """
    if _is_raw(path) or _is_exr(path):
        return False
    with _open(path) as picture:
        if picture.format == "HEIF":
            with open_file(path) as file:
                head = file.read(256)
            brands = head[8 : int.from_bytes(head[:4], "big")]  # ISO/IEC 14496-12, 4.3; tmap stands for gain maps
            return b"tmap" in brands or any(name.decode() in picture.info.get("aux", ()) for name in _GAIN_MAPS)
        if not isinstance(picture, JpegImageFile):
            return False
        segments = [content for _, content in picture.applist]
        with suppress(Exception):  # the other pictures are not needed, and may be broken
            for number in range(1, min(getattr(picture, "n_frames", 1), _PICTURES)):
                picture.seek(number)
                segments += [content for _, content in picture.applist]
    return any(name in content for name in _GAIN_MAPS for content in segments)


def read_focal_length(path: Path) -> float | None:
    """Return a photo's focal length in pixels, from its EXIF. Return None if EXIF does not give it.

    The focal length that is equivalent on 35 mm film is preferred. Otherwise the focal length in mm is multiplied by the sensor's pixels
    per mm. Raises InputError naming the file.
    """
    size = read_header(path)[:2]
    try:
        if _is_raw(path):
            tags = raw.read_exif(path)
        else:
            with _open(path) as picture:
                tags = Image.Image.getexif(picture).get_ifd(ExifTags.IFD.Exif)
        if film := float(tags.get(ExifTags.Base.FocalLengthIn35mmFilm, 0)):
            return film / math.hypot(36, 24) * math.hypot(*size)
        unit = {2: 25.4, 3: 10.0, 4: 1.0}[tags[ExifTags.Base.FocalPlaneResolutionUnit]]  # mm
        density = float(tags[ExifTags.Base.FocalPlaneXResolution]) / unit
        # The density is that of the photo as taken; it may have been scaled since.
        scale = max(size) / max(tags[ExifTags.Base.ExifImageWidth], tags[ExifTags.Base.ExifImageHeight])
        return float(tags[ExifTags.Base.FocalLength]) * density * scale or None
    except Exception:  # absent or broken
        return None


def read_image(path: Path, shrink: int = 1, is_data: bool = False) -> tuple[np.ndarray, np.ndarray | None]:
    """Decode an image file to RGB (H, W, 3) uint8 and alpha (H, W) uint8, None without alpha.

    The image is turned upright by its EXIF orientation. Greyscale files and those with more than 8 bits are converted to 8-bit RGB. Colours
    are converted to sRGB by the file's profile; with `is_data`, as for normals, codes stay as stored. `shrink` is 1, 2, 4 or 8. A JPEG's
    sides are divided by `shrink`. If this leaves a remainder, `shrink` is halved until both sides can be divided by it. A RAW photo's sides
    are halved at most, and other formats are not reduced. Raises InputError naming the file if it is truncated or unreadable.
    """
    image, alpha, white = read_codes(path, shrink, is_data)
    return as_bytes(image, white), alpha


def read_codes(path: Path, shrink: int = 1, is_data: bool = False) -> tuple[np.ndarray, np.ndarray | None, int]:
    """Decode an image file to RGB codes (H, W, 3), alpha (H, W) uint8 or None, and the code of white.

    Codes are uint8 if the file has 8 bits a channel, and uint16 if it has more or is HDR. The arguments and errors are those of
    `read_image`.
    """
    if _is_raw(path):
        width, height, turns = raw.read_raw_header(path)
        linear = raw.read_raw(path, half=_divisor(shrink, width, height) > 1)
        np.take(_encoding_table(), linear, out=linear, mode="clip")  # the other modes make a copy
        return np.ascontiguousarray(np.rot90(linear, -turns)), None, raw.WHITE
    if _is_exr(path):
        return *_exr_codes(path), HDR_WHITE
    with _open(path) as picture:
        turns = _turns(picture)
        profile = None if is_data else declared_profile(picture, path)
        look_up = profile if isinstance(profile, LookUp) else None
        pixels = None if look_up else _decode_16_bit(picture, path)
        white = 255 if pixels is None else 65535
        if pixels is None:
            width, height = picture.size
            shrink = _divisor(shrink, width, height)
            if picture.format in ("JPEG", "MPO"):
                check_scans(path, width, height)
                picture.draft(picture.mode, (width // shrink, height // shrink))
            pixels = _as_array(_decode(picture, path, look_up), look_up)
        picture.close()  # its pixels take as much memory as their copy
    pixels = np.rot90(pixels, -turns)
    alpha = np.ascontiguousarray(as_bytes(pixels[..., 3], white)) if pixels.shape[2] == 4 else None
    image = np.ascontiguousarray(pixels[..., :3])
    if isinstance(profile, Profile):
        image, white = profile.to_srgb(image)
    return image, alpha, white


def _exr_codes(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Decode an EXR to 16-bit codes (H, W, 3) and alpha uint8 or None."""
    pixels = np.nan_to_num(read_exr(path))
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=2)
    if pixels.shape[2] == 3:
        return encode(pixels, HDR_WHITE), None
    alpha = np.clip(pixels[..., 3:], 0, 1)  # premultiplied
    image = np.where(alpha > 0, pixels[..., :3] / np.maximum(alpha, 1e-6), 0)
    return encode(image, HDR_WHITE), np.rint(alpha[..., 0] * 255).astype(np.uint8)


def write_for_colmap(path: Path, out: Path) -> bool:
    """Write a photo's pixels to the JPEG `out` if COLMAP may be unable to read the photo.

    COLMAP reads JPEG, PNG, BMP, and TIFF that is stored upright. All other photos are written, such as HEIC, RAW and EXR. Return whether
    the JPEG was written. Pixels are not turned upright: the size of the JPEG is the `width` and `height` of the photo's `Header`. Raises
    InputError naming the file.
    """
    if _is_raw(path) or _is_exr(path):
        stored = np.rot90(read_image(path)[0], read_header(path).turns)
        Image.fromarray(np.ascontiguousarray(stored)).save(out, "JPEG", quality=95, subsampling=0)
        return True
    with _open(path) as picture:
        turned = picture.format == "TIFF" and Image.Image.getexif(picture).get(ExifTags.Base.Orientation, 1) != 1
        if picture.format in ("JPEG", "MPO"):
            check_scans(path, *picture.size)
        if picture.format in ("JPEG", "MPO", "PNG", "TIFF", "BMP") and not turned:
            return False
        _decode(picture, path).convert("RGB").save(out, "JPEG", quality=95, subsampling=0)
    return True


def read_mask(path: Path, below: float | None = None) -> np.ndarray:
    """Read a mask file as (H, W) uint8: 255 is the object, 0 the background.

    If the file has an alpha channel that is not opaque everywhere, the alpha channel is the mask. Otherwise the brightness is the mask. If
    the mask has only two different values, such as 0 and 1, the smaller is the background and the larger the object. If the file has a
    coloured palette, the smallest index in use is the background, and all others are the object. If `below` is given, the file is a depth
    map instead: the object is where depth is less than `below` times the largest possible value.
    """
    if below is not None:
        return np.where(read_image(path, is_data=True)[0][..., 0] < 255 * below, np.uint8(255), np.uint8(0))
    values, white = _stored_numbers(path), 255
    if values is None:
        image, alpha, white = read_codes(path, is_data=True)
        values = image.max(axis=2)
        if alpha is not None and alpha.min() < 255:
            values, white = alpha, 255
    low, high = values.min(), values.max()
    if np.count_nonzero(values == low) + np.count_nonzero(values == high) >= values.size:
        return np.where(values > (low if low < high else 0), np.uint8(255), np.uint8(0))
    return as_bytes(values, white)


def _stored_numbers(path: Path) -> np.ndarray | None:
    """Read the numbers (H, W) that a mask's file stores, upright, without decoding them as colours.

    - Black-and-white or grey picture: its codes.
    - Picture with a coloured palette: bool, true for all indices but the smallest in use.
    - Picture of 32-bit numbers with at most two different values: these numbers.
    - Any other file: None.
    """
    if _is_raw(path) or _is_exr(path):
        return None
    with _open(path) as picture:
        if picture.mode not in ("1", "L", "P", "I", "F") or picture.has_transparency_data:
            return None
        with _decoding(path):
            values = np.rot90(np.asarray(picture), -_turns(picture))
        if picture.mode in ("1", "L"):
            return values
        if picture.mode != "P":
            return values if np.isfinite(values).all() and len(np.unique(values)) <= 2 else None
        colors = np.zeros((256, 3), np.uint8)
        palette = np.array(picture.getpalette("RGB"), np.uint8).reshape(-1, 3)
    colors[: len(palette)] = palette
    used = np.unique(values)
    shown = colors[used]
    if np.ptp(shown, axis=1).max() == 0 and len(np.unique(shown, axis=0)) == len(used):
        return None  # grey
    return values > (used[0] if len(used) > 1 else 0)


def read_numbers(path: Path) -> np.ndarray | None:
    """Read the 32-bit numbers (H, W) of a grey TIFF as float32. Return None for any other picture. Raises InputError naming the file."""
    with _open(path) as picture:
        if picture.mode not in ("I", "F"):
            return None
        with _decoding(path):
            return np.asarray(picture, np.float32)


def read_alpha(view: View) -> np.ndarray | None:
    """Return a photo's mask (H, W) uint8, or None if it has none. The mask has the photo's full size, and is upright but not undistorted.

    Some programs store a mask turned like the photo's stored pixels, but without an EXIF orientation. Therefore a mask file whose size is
    not that of the upright photo is turned as the photo's EXIF says.
    """
    if view.mask_path is None:
        return read_image(view.image_path, is_data=True)[1] if view.has_alpha else None
    return _file_mask(view, view.mask_path)


def _file_mask(view: View, file: Path) -> np.ndarray:
    """Read a view's mask (H, W) uint8 from `file`, upright like the photo."""
    mask = read_mask(file, view.mask_below)
    if mask.shape != (view.camera.height, view.camera.width):
        mask = np.rot90(mask, -read_header(view.image_path).turns).copy()  # torch takes no negative strides
    return mask


def load_view(view: View, max_side: int | None = None) -> LoadedView:
    """Load a photo for training: decode it, apply its mask, undistort it, and reduce its longer side to `max_side` pixels, if given.

    When a photo is reduced, linear radiance is averaged over each new pixel's area, as a coarser sensor would do. The average is weighted
    by alpha, so that colours outside the mask do not bleed into its edge. If a JPEG is much larger than the result, its decoder reduces it
    first, to at least SPARE times the size of the result. The decoder averages encoded values, and ignores the mask.

    Raises InputError naming the file.
    """
    camera, lens = view.camera, view.lens
    if read_header(view.image_path).upright != (camera.width, camera.height):
        raise InputError(f"{view.image_path}: the photo changed its size since the capture was read. Start again.")
    fitted = camera.fitted(max_side) if max_side else camera
    shrink = next(n for n in (8, 4, 2, 1) if n == 1 or n * SPARE * fitted.width <= camera.width)
    image, own_alpha, white = read_codes(view.image_path, shrink)
    alpha = own_alpha if view.has_alpha else None
    if view.mask_path is not None:
        alpha = _file_mask(view, view.mask_path)
        if alpha.shape != (camera.height, camera.width):
            raise InputError(f"{view.mask_path}: the mask changed its size since the capture was read. Start again.")
    if lens is None and fitted is camera:
        return LoadedView(image, alpha, camera, white)
    height, width = image.shape[:2]
    if width < camera.width:
        part = width / camera.width
        camera = camera.resized(width, height)
        lens = lens and lens.resized(part, part)
        alpha = alpha if alpha is None else cv2.resize(alpha, (width, height), interpolation=cv2.INTER_AREA)
    return LoadedView(*reduced(image, alpha, white, camera, fitted, lens), fitted, white)


def _is_raw(path: Path) -> bool:
    return path.suffix.lower() in raw.SUFFIXES


def _is_exr(path: Path) -> bool:
    return path.suffix.lower() == ".exr"


def _divisor(shrink: int, width: int, height: int) -> int:
    """Halve `shrink`, a power of two, until it divides both sides."""
    while width % shrink or height % shrink:
        shrink //= 2
    return shrink


def _open(path: Path) -> ImageFile.ImageFile:
    try:
        check_length(path)
        picture = Image.open(path, formats=tuple(FORMATS))
    except FileNotFoundError:
        raise InputError(f"{path}: the image is missing. Put it back, or remove it from the capture.") from None
    except Exception as error:
        if is_shortage(error):
            raise
        raise InputError(f"{path}: this is not an image that can be read ({reason(error)}). Replace it.") from error
    if picture.mode in ("1", "L"):
        check_pixels(path, *picture.size)
    else:
        check_pixels(path, *picture.size, PHOTO, MOST_OF_PHOTO)
    return picture


def _turns(picture: Image.Image) -> int:
    """Return the clockwise quarter turns that make a decoded picture upright."""
    if picture.format in ("TIFF", "HEIF"):
        return 0
    try:
        # Not picture.getexif(), which decodes a PNG to look behind its pixels.
        return _TURNS.get(Image.Image.getexif(picture).get(ExifTags.Base.Orientation, 1), 0)
    except Exception:  # broken EXIF: the pixels are still good
        return 0


@contextmanager
def _decoding(path: Path) -> Iterator[None]:
    """Turn a decoder's errors into an InputError that names the file."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        if is_shortage(error):
            raise
        raise InputError(f"{path}: the image is truncated or broken ({reason(error)}). Replace it.") from error


def _decode(picture: Image.Image, path: Path, look_up: LookUp | None = None) -> Image.Image:
    """Decode a picture to 8-bit RGB, RGBA, grey, or the mode of `look_up`."""
    # By Pillow, because OpenCV does not detect a truncated file. Grey stays one channel: a mask of 256 million pixels would take 2 GB in
    # colour.
    with _decoding(path):
        if picture.mode.startswith("I;16"):
            values = np.asarray(picture, dtype=np.float64) / 257
            picture = Image.fromarray(np.rint(values).astype(np.uint8))
        elif picture.mode in ("I", "F"):
            raise InputError(f"{path}: the image holds 32-bit numbers; save it as EXR, or as 16-bit PNG, sRGB-encoded.")
        mode = look_up.mode if look_up else "RGB"
        mode = "RGBA" if picture.has_transparency_data and mode == "RGB" else mode
        picture.load()
        if picture.mode == "La":  # premultiplied grey, of which Pillow makes no RGBA
            grey, alpha = picture.split()
            divided = np.asarray(grey) * 255.0 / np.maximum(np.asarray(alpha), 1)
            picture = Image.merge("LA", [Image.fromarray(np.rint(np.minimum(divided, 255)).astype(np.uint8)), alpha])
        kept = picture.mode == mode or (look_up is None and mode == "RGB" and picture.mode in ("1", "L"))
        return picture if kept else picture.convert(mode)


def _as_array(picture: Image.Image, look_up: LookUp | None) -> np.ndarray:
    """Copy a picture to uint8 (H, W, 3 | 4), converted by `look_up` if given."""
    # In strips, because Pillow makes a temporary copy of what is copied.
    mode = "RGBA" if picture.mode == "RGBA" else "RGB"
    pixels = np.empty((picture.height, picture.width, len(mode)), np.uint8)
    for top in range(0, picture.height, ROWS):
        bottom = min(top + ROWS, picture.height)
        strip = picture.crop((0, top, picture.width, bottom))
        pixels[top:bottom] = np.asarray(look_up.to_srgb(strip) if look_up else strip.convert(mode))
    return pixels


def _decode_16_bit(picture: ImageFile.ImageFile, path: Path) -> np.ndarray | None:
    """Decode a picture of over 8 bits to RGB or RGBA uint16, or return None."""
    # By OpenCV, because Pillow keeps only the upper 8 bits of colours. Pillow first checks that the file is not truncated.
    if picture.format == "HEIF" and picture.info["bit_depth"] > 8:
        return _decode_heic(picture, path)
    tags = getattr(picture, "tag_v2", {})
    deep = set(tags.get(BITSPERSAMPLE, ())) == {16} or (picture.format == "PNG" and ";16" in str(picture.tile))
    if not deep or "transparency" in picture.info:
        return None
    size, bands, associated = picture.size, len(picture.getbands()), tags.get(EXTRASAMPLES, (0,))[0] == 1
    check_pixels(path, *size, DEEP_PHOTO, MOST_OF_PHOTO)
    if tags.get(PLANAR_CONFIGURATION) == 2:  # a plane a channel: neither of the two decodes it right
        with _decoding(path):
            pixels = np.moveaxis(tifffile.imread(path, key=0), 0, -1)
        pixels = np.rot90(pixels, -_TURNS.get(tags.get(ExifTags.Base.Orientation, 1), 0))
    else:
        _decode(picture, path)
        check_chunks(path)
        pixels = decode(path, cv2.IMREAD_UNCHANGED, *size)
        if pixels is not None:
            order = {2: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}
            pixels = cv2.cvtColor(pixels, order[pixels.ndim if pixels.ndim == 2 else pixels.shape[2]])
    if pixels is None or pixels.dtype != np.uint16 or pixels.shape[1::-1] != size:
        return None
    if tags.get(PHOTOMETRIC_INTERPRETATION) == 0:  # 0 is white
        np.subtract(65535, pixels, out=pixels)
    pixels = pixels[..., : max(bands, 3)]  # more are no alpha
    if associated and bands == 4:  # premultiplied
        alpha = np.maximum(pixels[..., 3:], 1).astype(np.float32)
        pixels[..., :3] = np.rint(np.minimum(pixels[..., :3] / alpha, 1) * 65535)
    return pixels


def _decode_heic(picture: ImageFile.ImageFile, path: Path) -> np.ndarray:
    """Decode a HEIC of over 8 bits a channel to RGB or RGBA uint16."""
    with _decoding(path):
        heic = open_heif(path, convert_hdr_to_8bit=False, hdr_to_16bit=False)
        largest = (1 << picture.info["bit_depth"]) - 1
        pixels = np.take(np.rint(np.arange(largest + 1) * (65535 / largest)).astype(np.uint16), np.asarray(heic))
    return np.repeat(pixels[..., None], 3, axis=2) if pixels.ndim == 2 else pixels


def as_bytes(codes: np.ndarray, white: int) -> np.ndarray:
    """Convert codes to 8 bits, clipped at the code `white`; uint8 codes stay."""
    return (
        codes
        if codes.dtype == np.uint8
        else np.rint(np.minimum(codes.astype(np.float32) / white, 1) * 255).astype(np.uint8)
    )


@cache
def _encoding_table() -> np.ndarray:
    """Return a table from 16-bit linear values to 16-bit sRGB codes, uint16 (65536,)."""
    return encode(np.arange(65536) / 65535, 65535)
