"""Hold a photo on the training's device, and find the crop of it that shows the object."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.capture import LoadedView
from refgs.color import srgb_decode

MARGIN = 10  # pixels around the mask; a D-SSIM window, whose radius is 5, never covers object and border

Crop = tuple[slice, slice]
"""Rows and columns of a photo."""


class Photo(NamedTuple):
    """Hold a view's photo on the training's device.

    - `image` (H, W, 3): sRGB values as integers, uint8 or uint16. The integer `white` stands for the value 1. The dtype's largest integer
      stands for its own value, and for all brighter values.
    - `mask` (H, W): how much of each pixel the object covers, as uint8 from 0 to 255. None if the photo has no mask.
    - `whole` (H, W): the size of the whole photo if this is a crop. Beyond the crop, the whole photo is background.
    """

    image: Tensor
    mask: Tensor | None
    camera: Camera
    whole: tuple[int, ...] | None = None
    white: int = 255

    @classmethod
    def of(cls, view: LoadedView, device: torch.device | str = "cpu") -> "Photo":
        mask = None if view.alpha is None else torch.from_numpy(view.alpha).to(device)
        return cls(torch.from_numpy(view.image).to(device), mask, view.camera, white=view.white)

    def part(self, rows: slice, columns: slice) -> "Photo":
        """Return this photo and its camera, cropped to ranges of rows and columns."""
        image = self.image[rows, columns].contiguous()
        mask = None if self.mask is None else self.mask[rows, columns].contiguous()
        camera = self.camera.cropped(columns.start, rows.start, image.shape[1], image.shape[0])
        return Photo(image, mask, camera, self.whole or self.image.shape[:2], self.white)

    @property
    def encoded(self) -> Tensor:
        """Return the sRGB-encoded photo, float32 (H, W, 3); an EXR may exceed 1 (white)."""
        return self.image.float() / self.white

    @property
    def linear(self) -> Tensor:
        """Return the photo's linear radiance (H, W, 3) over black."""
        image = srgb_decode(self.encoded)
        return image if self.mask is None else image * (self.mask.float() / 255)[..., None]

    def over(self, background: Tensor) -> Tensor:
        """Composite the photo over a background (3,), sRGB-encoded (H, W, 3) and clipped to white."""
        image = self.encoded.clamp_max(1)
        if self.mask is None:
            return image
        opaque = self.mask.float()[..., None] / 255
        return image * opaque + background * (1 - opaque)

    @property
    def clipped(self) -> Tensor:
        """Tell which channels, bool (H, W, 3), are clipped or nearly clipped."""
        return self.image.float() >= torch.iinfo(self.image.dtype).max // 255 * 254


def crop_of(view: LoadedView, margin: int) -> Crop:
    """Return the mask's bounds plus `margin` pixels, or the whole photo without a mask."""
    height, width = view.image.shape[:2]
    return (slice(0, height), slice(0, width)) if view.alpha is None else bounds(view.alpha, margin)


def bounds(mask: np.ndarray, margin: int) -> Crop:
    """Return the smallest ranges of rows and columns that contain a mask (H, W), enlarged by `margin` pixels on each side.

    If the mask is empty, return all rows and columns.
    """
    shown = []
    for axis, size in ((1, mask.shape[0]), (0, mask.shape[1])):
        there = np.flatnonzero(mask.any(axis=axis)) if mask.any() else np.array([0, size - 1])
        shown.append(slice(max(int(there[0]) - margin, 0), min(int(there[-1]) + 1 + margin, size)))
    rows, columns = shown
    return rows, columns
