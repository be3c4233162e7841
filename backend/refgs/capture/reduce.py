"""Undistort and reduce photos in linear radiance, and reduce maps such as normals.

Photos are reduced a strip at a time: as floats, a whole photo would take ten times its file's memory.
"""

from functools import cache

import cv2
import numpy as np

from refgs.camera import Camera
from refgs.capture.lens import Lens
from refgs.color import srgb_decode, srgb_encode

STRIP = 1 << 16  # pixels of the photo in a strip, about


def reduced(
    image: np.ndarray, alpha: np.ndarray | None, white: int, camera: Camera, fitted: Camera, lens: Lens | None = None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Undistort a photo by `lens`, if given, and reduce it from the size of `camera` to that of `fitted`. Returns new codes and alpha.

    `image` (H, W, 3) are sRGB codes, uint8 or uint16, in which `white` is the code of radiance 1. `alpha` (H, W) is uint8 or None. Linear
    radiance is averaged over each new pixel's area, weighted by alpha. If `alpha` is None, the new alpha is None, too. Otherwise fully
    transparent pixels are black.
    """
    size = fitted.height, fitted.width
    codes, opaque = np.empty((*size, 3), image.dtype), None if alpha is None else np.empty(size, np.uint8)
    ratio = camera.height / fitted.height
    step = max(1, int(STRIP / camera.width / ratio))
    for top in range(0, fitted.height, step):
        rows = slice(top, min(top + step, fitted.height))
        # The strip's area in the photo begins and ends between two rows; a little less, for rounding.
        source = slice(int(rows.start * ratio + 1e-6), min(int(np.ceil(rows.stop * ratio - 1e-6)), camera.height))
        given = image, alpha, white, source
        linear = _linear(*given) if lens is None else _undistorted(*given, camera, lens)
        if camera.width != fitted.width:
            linear = cv2.resize(linear, (fitted.width, len(linear)), interpolation=cv2.INTER_AREA)
        if camera.height != fitted.height:
            weights = _area_weights(rows, source, ratio)
            linear = (weights @ linear.reshape(len(linear), -1)).reshape(len(weights), fitted.width, -1)
        if opaque is not None:
            weight = linear[..., 3]
            opaque[rows] = np.rint(np.clip(weight, 0, 1) * 255)
            divisor = np.where(opaque[rows] == 0, np.float32(np.inf), np.maximum(weight, 1e-6))
            linear = np.stack([linear[..., channel] / divisor for channel in range(3)], axis=-1)
        codes[rows] = encode(linear, white)
    return codes, opaque


def reduced_map(values: np.ndarray, alpha: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Reduce a map (H, W) or (H, W, C), such as normals, and its alpha (H, W) to the size of `camera`, both as float32.

    Values are averaged over each new pixel's area, weighted by alpha. They are 0 where alpha is 0. Means of unit vectors are shorter than
    1.
    """
    weights = alpha if values.ndim == 2 else alpha[..., None]
    size = camera.width, camera.height
    mean, weight = (
        cv2.resize(each.astype(np.float32), size, interpolation=cv2.INTER_AREA) for each in (values * weights, alpha)
    )
    divisor = np.maximum(weight, 1e-6)
    return mean / (divisor if values.ndim == 2 else divisor[..., None]), weight


def encode(linear: np.ndarray, white: int) -> np.ndarray:
    """Encode linear radiance to sRGB, radiance 1 to `white`: 8-bit if 255, else 16-bit."""
    if white == 255:
        return np.rint(srgb_encode(np.clip(linear, 0, 1)) * 255).astype(np.uint8)
    bounded = np.clip(linear, 0, 1000)  # which is beyond every code
    return np.minimum(np.rint(srgb_encode(bounded) * white), 65535).astype(np.uint16)


def _linear(image: np.ndarray, alpha: np.ndarray | None, white: int, rows: slice) -> np.ndarray:
    """Decode rows of a photo to linear radiance, float32, or premultiplied RGBA with alpha."""
    table = _decoding_table(np.iinfo(image.dtype).max, white)
    part = image[rows]
    linear = cv2.LUT(part, table) if part.dtype == np.uint8 else np.take(table, part)
    if alpha is None:
        return linear
    weight = alpha[rows].astype(np.float32) / 255
    premultiplied = np.empty((*weight.shape, 4), np.float32)
    for channel in range(3):  # several times as fast as all at once
        np.multiply(linear[..., channel], weight, out=premultiplied[..., channel])
    premultiplied[..., 3] = weight
    return premultiplied


def _undistorted(
    image: np.ndarray, alpha: np.ndarray | None, white: int, rows: slice, camera: Camera, lens: Lens
) -> np.ndarray:
    """Return rows of the photo undistorted for the pinhole `camera`, as `_linear` does."""
    across, down = lens.maps(camera, rows)
    first = min(max(int(np.floor(down.min())), 0), len(image) - 1)
    last = min(max(int(np.floor(down.max())) + 1, first), len(image) - 1)
    linear = _linear(image, alpha, white, slice(first, last + 1))
    # Interpolated linearly, because wider kernels overshoot at highlights.
    return cv2.remap(linear, across, down - first, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _area_weights(rows: slice, source: slice, ratio: float) -> np.ndarray:
    """Return a matrix (R, S) that averages rows `source` to R rows, `ratio` times fewer."""
    edges = np.arange(rows.start, rows.stop + 1) * ratio
    row = np.arange(source.start, source.stop)
    shared = np.minimum(row + 1, edges[1:, None]) - np.maximum(row, edges[:-1, None])
    weights = np.maximum(shared, 0)
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


@cache
def _decoding_table(largest: int, white: int) -> np.ndarray:
    """Return the linear radiance, float32, of sRGB codes to `largest`, where `white` has 1."""
    return srgb_decode(np.arange(largest + 1) / white).astype(np.float32)
