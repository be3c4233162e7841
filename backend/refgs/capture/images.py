"""Load photos and masks for training: decode, undistort and reduce them. The results are 8-bit sRGB with straight alpha."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from refgs.camera import Camera
from refgs.capture.types import View
from refgs.color import srgb_decode, srgb_encode
from refgs.errors import InputError


@dataclass(frozen=True, eq=False)
class LoadedView:
    """Pixels of a photo as loaded for training: `image` (H, W, 3) uint8, sRGB-encoded, and `alpha` (H, W) uint8, None without a mask.

    Colours are not premultiplied by alpha. `camera` is the pinhole camera for this image size. If the photo was reduced or undistorted, its
    fully transparent pixels are black.
    """

    image: np.ndarray
    alpha: np.ndarray | None
    camera: Camera


def read_header(path: Path) -> tuple[int, int, bool]:
    """Return an image file's width, its height, and whether it has alpha. No pixels are decoded. Raises InputError naming the file."""
    with _open(path) as picture:
        return *picture.size, picture.has_transparency_data


def read_image(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Decode an image file to RGB (H, W, 3) uint8 and alpha (H, W) uint8, None without alpha.

    16-bit and greyscale files are converted to 8-bit RGB. The EXIF rotation is ignored, as in COLMAP and nerfstudio. Raises InputError
    naming the file if it is truncated or unreadable.
    """
    with _open(path) as picture:
        pixels = np.asarray(_decode(picture, path))
    return pixels[..., :3].copy(), (pixels[..., 3].copy() if pixels.shape[2] == 4 else None)


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
    """Return a photo's mask (H, W) uint8, None if it has none. It is not undistorted and has the size of the file."""
    if view.mask_path is not None:
        return read_mask(view.mask_path, view.mask_below)
    return read_image(view.image_path)[1] if view.has_alpha else None


def load_view(view: View, max_side: int | None = None) -> LoadedView:
    """Load a photo for training: decode it, apply its mask, undistort it, reduce its longer side to `max_side` pixels (None: full size).

    When a photo is reduced, linear radiance is averaged over each new pixel's area, as a coarser sensor would do. The average is weighted
    by alpha, so that colours outside the mask do not bleed into its edge. Raises InputError naming the file.
    """
    image, own_alpha = read_image(view.image_path)
    alpha = own_alpha if view.has_alpha else None
    if view.mask_path is not None:
        alpha = read_mask(view.mask_path, view.mask_below)
    camera = view.camera
    if image.shape[:2] != (camera.height, camera.width):
        raise InputError(f"{view.image_path}: the photo changed its size since the capture was read. Start again.")
    if alpha is not None and alpha.shape != image.shape[:2]:
        raise InputError(f"{view.mask_path}: the mask changed its size since the capture was read. Start again.")
    fitted = camera.fitted(max_side) if max_side else camera
    if view.lens is None and fitted is camera:
        return LoadedView(image, alpha, camera)

    linear = _decoding_table()[image]
    if alpha is not None:
        weight = alpha.astype(np.float32) / 255
        premultiplied = np.empty((*weight.shape, 4), np.float32)
        np.multiply(linear, weight[..., None], out=premultiplied[..., :3])
        premultiplied[..., 3] = weight
        linear = premultiplied
    if view.lens is not None:
        # Linear, because wider kernels overshoot at highlights.
        linear = cv2.remap(linear, *view.lens.maps(camera), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
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
