"""Load the parts of photos that show an object, from which its masks are made: pixels, strokes, and what a segmentation model says.

An object is often small in its photos. The model sees thin parts, and takes less of the surroundings along, if it gets only the part around
the object; and as many pixels there give finer edges.
"""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from refgs.camera import Camera
from refgs.capture import salience
from refgs.capture.box import Box
from refgs.capture.images import load_view, read_image
from refgs.capture.lens import Lens
from refgs.capture.salience import SalienceModel
from refgs.capture.silhouettes import Photo
from refgs.capture.types import View
from refgs.errors import InputError
from refgs.geometry.project import project

FINE = 512  # pixels on the longer side of a part, in which edges are found
AROUND = 0.15  # of the box's size in a photo, on each side of it, that is looked at as well


def inner_path(view: View, root: Path) -> Path:
    """Return a photo's path relative to `root`, without its first folder, such as `images`.

    The photo's mask has the same path in the folder `masks`, apart from the suffix. Raises InputError if the photo is not in `root`.
    """
    if not view.image_path.is_relative_to(root):
        raise InputError(f"{view.image_path}: the photo is not in the capture's folder {root}. Move it there.")
    path = view.image_path.relative_to(root)
    return Path(*path.parts[1:]) if len(path.parts) > 1 else path


def stroke_file(view: View, root: Path) -> Path | None:
    """Return the file of the artist's strokes on a photo, or None."""
    name = inner_path(view, root)
    files = (root / "strokes" / name.with_suffix(".png"), root / "strokes" / name.with_name(name.name + ".png"))
    return next((file for file in files if file.is_file()), None)


def find_judge(model: Path | None) -> "Judge | None":
    """Load the artist's model, or RefGS's own. Return None if neither is there."""
    if model is None and not salience.MODEL.is_file():
        return None
    return Judge(SalienceModel(model or salience.MODEL))


class Part(NamedTuple):
    """Hold which part of a photo is looked at, and how far the photo is reduced.

    `bounds` are its left, upper, right and lower edge, as fractions of the photo's width and height. `side` is the longer side of the
    reduced photo, in pixels; the part has the pixels `rows` and `columns` of it.
    """

    view: View
    bounds: tuple[float, float, float, float]
    side: int
    rows: slice
    columns: slice

    @classmethod
    def of(cls, bounds: tuple[float, float, float, float], view: View, side: int) -> "Part":
        """Return the part within `bounds`, with `side` pixels on its longer side, or fewer if the photo has fewer."""
        camera = view.camera
        extent = max((bounds[2] - bounds[0]) * camera.width, (bounds[3] - bounds[1]) * camera.height)
        longer = max(camera.width, camera.height)
        small = camera.fitted(min(longer, round(side * longer / extent)))
        columns, rows = (
            slice(int(low * size), max(int(low * size) + 1, int(np.ceil(high * size))))
            for low, high, size in ((bounds[0], bounds[2], small.width), (bounds[1], bounds[3], small.height))
        )
        return cls(view, bounds, max(small.width, small.height), rows, columns)

    @classmethod
    def whole(cls, view: View, side: int) -> "Part":
        return cls.of((0.0, 0.0, 1.0, 1.0), view, side)

    @classmethod
    def around(cls, box: Box, view: View, side: int, root: Path) -> "Part":
        """Return the part that shows a box, with AROUND of its size on each side.

        A photo is taken whole if it does not show the box, or if the artist has drawn on it, perhaps beside the box: see `stroke_file`.
        """
        if stroke_file(view, root):
            return cls.whole(view, side)
        at, depth = project(view.camera, box.grid(2))
        size = np.array([view.camera.width, view.camera.height])
        low, high = at.min(axis=0) / size, at.max(axis=0) / size
        low, high = (np.clip(edge, 0, 1) for edge in (low - AROUND * (high - low), high + AROUND * (high - low)))
        if (depth <= 0).any() or ((high - low) * size < 1).any():
            return cls.whole(view, side)
        return cls.of((*low.tolist(), *high.tolist()), view, side)

    def cut(self, pixels: np.ndarray) -> np.ndarray:
        """Return the part of a reduced photo (H, W, …)."""
        return pixels[self.rows, self.columns]

    def paste(self, mask: np.ndarray) -> np.ndarray:
        """Return the mask (H, W) uint8 of the whole reduced photo, from that of the part."""
        small = self.view.camera.fitted(self.side)
        whole = np.zeros((small.height, small.width), np.uint8)
        whole[self.rows, self.columns] = mask
        return whole


class Judge:
    """Find the object in photos with a segmentation model, and keep the results, because the model may take seconds for a photo."""

    def __init__(self, model: SalienceModel):
        self.model = model
        self.found: dict[tuple[Path, tuple], np.ndarray] = {}

    def __call__(self, part: Part) -> np.ndarray:
        """Return the object's probability at each pixel of a photo's part, float32 (H, W)."""
        key = part.view.image_path, part.bounds
        if key not in self.found:
            large = Part.of(part.bounds, part.view, self.model.side)
            likely = self.model(np.ascontiguousarray(large.cut(load_view(part.view, large.side).bytes)))
            shrink = min(1.0, FINE / max(likely.shape))
            small = cv2.resize(likely, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
            self.found[key] = np.rint(255 * small).astype(np.uint8)
        size = part.columns.stop - part.columns.start, part.rows.stop - part.rows.start
        return cv2.resize(self.found[key], size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255


def load_ahead(parts: list[Part], root: Path, judge: Judge | None) -> Iterator[Photo]:
    """Load the parts of photos one after the other (see `load_part`), each while the one before it is used."""
    with ThreadPoolExecutor(1) as thread:
        ahead: deque[Future[Photo]] = deque()
        for part in parts:
            ahead.append(thread.submit(load_part, part, root, judge))
            if len(ahead) > 1:
                yield ahead.popleft().result()
        for loading in ahead:
            yield loading.result()


def load_part(part: Part, root: Path, judge: Judge | None) -> Photo:
    """Load part of a photo, undistorted and reduced.

    Return a Photo. Its `known` comes from the artist's mask or strokes, its `salient` from the segmentation model `judge`, if given.
    """
    view, loaded = part.view, load_view(part.view, part.side)
    known = np.zeros(loaded.image.shape[:2], np.int8)
    if loaded.alpha is not None:
        known = np.where(loaded.alpha > 127, np.int8(1), np.int8(-1))
    elif (file := stroke_file(view, root)) is not None:
        known = _read_strokes(file, view, loaded.camera)
    salient = None if judge is None else judge(part)
    image, known = (np.ascontiguousarray(part.cut(pixels)) for pixels in (loaded.bytes, known))
    camera = loaded.camera.cropped(part.columns.start, part.rows.start, known.shape[1], known.shape[0])
    return Photo(image, camera, known, salient)


def _read_strokes(file: Path, view: View, camera: Camera) -> np.ndarray:
    """Read an artist's strokes as int8 (H, W): 1 marks the object, −1 the background, 0 says nothing.

    The strokes are undistorted and resized to `camera`, like the photo. Raises InputError if they lack transparency, or if their aspect
    ratio is not the photo's.
    """
    color, alpha = read_image(file, is_data=True)
    height, width = color.shape[:2]
    if abs(width / height * view.camera.height / view.camera.width - 1) > 0.02:
        raise InputError(
            f"{file}: the strokes have {width}×{height} pixels, which is not the shape of the photo "
            f"({view.camera.width}×{view.camera.height}). Draw them on the photo."
        )
    if alpha is None:
        raise InputError(
            f"{file}: the strokes have no transparency. Save them with it: transparent where nothing is said."
        )
    sides = [((color.mean(axis=2) > 127) == white) & (alpha > 127) for white in (True, False)]
    drawn = []
    for side in sides:
        part = cv2.resize(side.astype(np.float32), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        if view.lens is not None:
            part = cv2.remap(part, *_small_lens(view.lens, view.camera, camera).maps(camera), cv2.INTER_LINEAR)
        drawn.append(part)
    ours, theirs = drawn
    return np.where(np.maximum(ours, theirs) < 0.3, 0, np.where(ours >= theirs, 1, -1)).astype(np.int8)


def _small_lens(lens: Lens, camera: Camera, small: Camera) -> Lens:
    """Return the lens of a photo that was reduced from the size of `camera` to that of `small`."""
    return lens.resized(small.width / camera.width, small.height / camera.height)


def to_photo(view: View, mask: np.ndarray) -> np.ndarray:
    """Convert a mask of the undistorted, reduced photo to a mask (H, W) uint8 of the upright, distorted photo at full size."""
    width, height = view.camera.width, view.camera.height
    # A step at a reduced pixel becomes a smooth edge, cut in its middle and soft over a pixel.
    smooth = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 0.7)
    if view.lens is not None:
        # Distorted before it is enlarged, by few positions with others in between: a lens bends little from pixel to pixel, and the
        # positions of all pixels take seconds.
        small, (rows, columns) = view.camera.fitted(FINE), mask.shape
        x, y = _small_lens(view.lens, view.camera, small).maps_back(small)
        x = cv2.resize((x + 0.5) * (columns / small.width) - 0.5, (columns, rows), interpolation=cv2.INTER_LINEAR)
        y = cv2.resize((y + 0.5) * (rows / small.height) - 0.5, (columns, rows), interpolation=cv2.INTER_LINEAR)
        smooth = cv2.remap(smooth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    large = cv2.resize(smooth, (width, height), interpolation=cv2.INTER_CUBIC)
    sharpness = max(1.0, max(width, height) / max(mask.shape))
    return np.rint(np.clip((large - 127.5) * sharpness + 127.5, 0, 255)).astype(np.uint8)
