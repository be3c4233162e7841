"""Load photos and masks for training: decode, undistort and reduce them. The results are 8-bit sRGB with straight alpha."""

import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from PIL import ExifTags, Image
from pillow_heif import register_heif_opener

from refgs.camera import Camera
from refgs.capture.types import View
from refgs.color import srgb_decode, srgb_encode
from refgs.errors import InputError

register_heif_opener()  # Pillow opens HEIC then

# The JPEG decoder leaves a photo at least this many times as large as wanted. It averages encoded values, which darkens highlights: at 2,
# a photo differs by 0.6 of 255 on average from one reduced in linear light (49 dB); at 1, by 1.7 (41 dB).
SPARE = 2

# Clockwise quarter turns that make a photo upright, by EXIF orientation. The mirrored orientations 2, 4, 5 and 7 are ignored: no camera
# sees a mirrored world.
_TURNS = {6: 1, 3: 2, 8: 3}


@dataclass(frozen=True, eq=False)
class LoadedView:
    """Pixels of a photo as loaded for training: `image` (H, W, 3) uint8, sRGB-encoded, and `alpha` (H, W) uint8, None without a mask.

    Colours are not premultiplied by alpha. `camera` is the pinhole camera for this image size. If the photo was reduced or undistorted, its
    fully transparent pixels are black.
    """

    image: np.ndarray
    alpha: np.ndarray | None
    camera: Camera


class Header(NamedTuple):
    """Size of an image as stored, in pixels; whether it has alpha; and the clockwise quarter turns that make it upright (EXIF)."""

    width: int
    height: int
    has_alpha: bool
    turns: int

    @property
    def upright(self) -> tuple[int, int]:
        """Return the width and height of the upright image. `read_image` returns it in this size."""
        return (self.height, self.width) if self.turns % 2 else (self.width, self.height)


def read_header(path: Path) -> Header:
    """Read an image file's header. No pixels are decoded. Raises InputError naming the file."""
    with _open(path) as picture:
        return Header(*picture.size, picture.has_transparency_data, _turns(picture))


def read_focal_length(path: Path) -> float | None:
    """Return a photo's focal length in pixels by its EXIF: that for 35 mm film, else in mm with the pixels per mm of the sensor.

    Return None if EXIF has neither. Raises InputError naming the file.
    """
    with _open(path) as picture:
        try:
            tags = Image.Image.getexif(picture).get_ifd(ExifTags.IFD.Exif)
            if film := float(tags.get(ExifTags.Base.FocalLengthIn35mmFilm, 0)):
                return film / math.hypot(36, 24) * math.hypot(*picture.size)
            unit = {2: 25.4, 3: 10.0, 4: 1.0}[tags[ExifTags.Base.FocalPlaneResolutionUnit]]  # mm
            density = float(tags[ExifTags.Base.FocalPlaneXResolution]) / unit
            # The density is that of the photo as taken; it may have been scaled since.
            scale = max(picture.size) / max(tags[ExifTags.Base.ExifImageWidth], tags[ExifTags.Base.ExifImageHeight])
            return float(tags[ExifTags.Base.FocalLength]) * density * scale or None
        except Exception:  # absent or broken
            return None


def read_image(path: Path, shrink: int = 1) -> tuple[np.ndarray, np.ndarray | None]:
    """Decode an image file to RGB (H, W, 3) uint8 and alpha (H, W) uint8, None without alpha.

    The image is turned upright by its EXIF orientation. 16-bit and greyscale files are converted to 8-bit RGB. `shrink` may be 2, 4 or 8: a
    JPEG is decoded at that fraction of its size, or a larger one that divides its sides. Raises InputError naming the file if it is
    truncated or unreadable.
    """
    with _open(path) as picture:
        turns = _turns(picture)
        width, height = picture.size
        while width % shrink or height % shrink:
            shrink //= 2
        if picture.format in ("JPEG", "MPO"):
            picture.draft(picture.mode, (width // shrink, height // shrink))
        pixels = np.rot90(np.asarray(_decode(picture, path)), -turns)
    return pixels[..., :3].copy(), (pixels[..., 3].copy() if pixels.shape[2] == 4 else None)


def write_for_colmap(path: Path, out: Path) -> bool:
    """Write a photo's pixels to the JPEG `out` if COLMAP cannot read them: HEIC, WebP, and TIFF that has to be turned upright.

    Return whether it was written. The pixels are turned as `Header` says that they are stored. Raises InputError naming the file.
    """
    with _open(path) as picture:
        turned = picture.format == "TIFF" and Image.Image.getexif(picture).get(ExifTags.Base.Orientation, 1) != 1
        if picture.format not in ("HEIF", "WEBP") and not turned:
            return False
        _decode(picture, path).convert("RGB").save(out, "JPEG", quality=95, subsampling=0)
    return True


def read_mask(path: Path, below: float | None = None) -> np.ndarray:
    """Read a mask file as (H, W) uint8: 255 is the object, 0 the background.

    If the file has an alpha channel that is not opaque everywhere, the alpha channel is the mask. Otherwise the brightness is the mask. A
    mask with the values 0 and 1 is scaled to 255. If `below` is given, the file is a depth map instead: the object is where depth is less
    than `below` times the largest possible value.
    """
    image, alpha = read_image(path)
    if below is not None:
        return np.where(image[..., 0] < 255 * below, np.uint8(255), np.uint8(0))
    if alpha is None or alpha.min() == 255:
        alpha = image.max(axis=2)
    return alpha * np.uint8(255) if alpha.max() == 1 else alpha


def read_alpha(view: View) -> np.ndarray | None:
    """Return a photo's mask (H, W) uint8, None if it has none. It is upright, not undistorted, and has the photo's full size.

    A mask file without an EXIF orientation may lie as its photo is stored. If only that fits the photo's size, it is turned with the photo.
    """
    if view.mask_path is None:
        return read_image(view.image_path)[1] if view.has_alpha else None
    mask = read_mask(view.mask_path, view.mask_below)
    if mask.shape != (view.camera.height, view.camera.width):
        mask = np.rot90(mask, -read_header(view.image_path).turns).copy()  # torch takes no negative strides
    return mask


def load_view(view: View, max_side: int | None = None) -> LoadedView:
    """Load a photo for training: decode it, apply its mask, undistort it, reduce its longer side to `max_side` pixels (None: full size).

    When a photo is reduced, linear radiance is averaged over each new pixel's area, as a coarser sensor would do. The average is weighted
    by alpha, so that colours outside the mask do not bleed into its edge. A much larger JPEG is first reduced by its decoder, to SPARE
    times the new size or more. The decoder averages encoded values, and does so across a mask's edge, too.

    Raises InputError naming the file.
    """
    camera, lens = view.camera, view.lens
    if read_header(view.image_path).upright != (camera.width, camera.height):
        raise InputError(f"{view.image_path}: the photo changed its size since the capture was read. Start again.")
    fitted = camera.fitted(max_side) if max_side else camera
    shrink = next(n for n in (8, 4, 2, 1) if n == 1 or n * SPARE * fitted.width <= camera.width)
    image, own_alpha = read_image(view.image_path, shrink)
    alpha = own_alpha if view.has_alpha else None
    if view.mask_path is not None:
        alpha = read_alpha(view)
        if alpha.shape != (camera.height, camera.width):
            raise InputError(f"{view.mask_path}: the mask changed its size since the capture was read. Start again.")
    if lens is None and fitted is camera:
        return LoadedView(image, alpha, camera)
    height, width = image.shape[:2]
    if width < camera.width:
        shrink = camera.width // width
        camera = camera.resized(width, height)
        if lens is not None:
            lens = replace(lens, fx=lens.fx / shrink, fy=lens.fy / shrink, cx=lens.cx / shrink, cy=lens.cy / shrink)
        alpha = alpha if alpha is None else cv2.resize(alpha, (width, height), interpolation=cv2.INTER_AREA)

    linear = _decoding_table()[image]
    if alpha is not None:
        weight = alpha.astype(np.float32) / 255
        premultiplied = np.empty((*weight.shape, 4), np.float32)
        np.multiply(linear, weight[..., None], out=premultiplied[..., :3])
        premultiplied[..., 3] = weight
        linear = premultiplied
    if lens is not None:
        # Linear, because wider kernels overshoot at highlights.
        linear = cv2.remap(linear, *lens.maps(camera), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    if fitted is not camera:
        linear = cv2.resize(linear, (fitted.width, fitted.height), interpolation=cv2.INTER_AREA)
    if alpha is not None:
        weight = linear[..., 3]
        linear = linear[..., :3] / np.maximum(weight, 1e-6)[..., None]
        alpha = np.rint(np.clip(weight, 0, 1) * 255).astype(np.uint8)
        linear[alpha == 0] = 0
    return LoadedView(_encode(linear), alpha, fitted)


def _open(path: Path) -> Image.Image:
    try:
        return Image.open(path)
    except FileNotFoundError:
        raise InputError(f"{path}: the image is missing. Put it back, or remove it from the capture.") from None
    except Exception as error:
        raise InputError(f"{path}: this is not an image that can be read ({_reason(error)}). Replace it.") from error


def _turns(picture: Image.Image) -> int:
    """Return the clockwise quarter turns that make an opened picture upright. Pillow itself turns TIFF, and libheif HEIC."""
    if picture.format in ("TIFF", "HEIF"):
        return 0
    try:
        # Not picture.getexif(), which decodes a PNG to look behind its pixels.
        return _TURNS.get(Image.Image.getexif(picture).get(ExifTags.Base.Orientation), 0)
    except Exception:  # broken EXIF: the pixels are still good
        return 0


def _decode(picture: Image.Image, path: Path) -> Image.Image:
    """Decode a picture to 8-bit RGB or RGBA. Pillow is used, because OpenCV does not detect a truncated file."""
    try:
        if picture.mode.startswith("I;16"):
            values = np.asarray(picture, dtype=np.float64) / 257
            picture = Image.fromarray(np.rint(values).astype(np.uint8))
        elif picture.mode in ("I", "F"):
            raise InputError(f"{path}: the image holds 32-bit numbers; save it as 8- or 16-bit PNG, sRGB-encoded.")
        return picture.convert("RGBA" if picture.has_transparency_data else "RGB")
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path}: the image is truncated or broken ({_reason(error)}). Replace it.") from error


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__


@cache
def _decoding_table() -> np.ndarray:
    """Return a table from 8-bit sRGB values to linear radiance, float32 (256,)."""
    return srgb_decode(np.arange(256) / 255).astype(np.float32)


def _encode(linear: np.ndarray) -> np.ndarray:
    return np.rint(srgb_encode(np.clip(linear, 0, 1)) * 255).astype(np.uint8)
