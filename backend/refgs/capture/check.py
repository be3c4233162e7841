"""Check a capture: decode all photos and masks, list its contents, and warn of likely mistakes."""

import math
import os
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from refgs.capture.box import Box
from refgs.capture.cameras import write_cameras
from refgs.capture.images import LoadedView, load_view
from refgs.capture.not_used import not_used
from refgs.capture.priors import FOLDERS, load_depth, load_normals
from refgs.capture.region import LOOK_OUT, ONE_SIDED
from refgs.capture.types import Capture, View
from refgs.errors import InputError, one_line
from refgs.paths import whole
from refgs.spread import spread

THUMBNAILS, THUMBNAIL_SIDE = 12, 128  # maximum number; pixels
BLURRED = 0.4  # part of the capture's median sharpness. Sharp photos reach at least 0.6; blurred by 2 pixels of 512, at most 0.2
BLACK, WHITE = 8, 235  # of 255: brightness of photos whose radiance has another unit, at the most and on the average

LAYOUTS = {
    "nerf-blender": "NeRF-Blender",
    "stanford-orb": "Stanford-ORB",
    "tensoir": "TensoIR-Synthetic",
    "nerfstudio": "nerfstudio / instant-ngp",
    "colmap": "COLMAP",
    "nero": "NeRO's Glossy Synthetic",
}


def check(capture: Capture, out: Path) -> dict[str, Any]:
    """Describe a capture in text with warnings. Write cameras.json and up to 12 thumbnails for a program that displays the capture.

    These files are written to the folder `out`, over those of an earlier check. Returns a dict: the paths `capture`, `cameras` and
    `thumbnails`; `centre` and `radius` of the region of interest (a ball), in the coordinates of cameras.json; and `lines`, the text from
    `describe`. Raises InputError if a photo, mask or prior cannot be read.
    """
    out.mkdir(parents=True, exist_ok=True)
    lines = describe(capture, out)
    write_cameras(out / "cameras.json", capture)
    return {
        "capture": str(capture.folder.resolve()),
        "cameras": str((out / "cameras.json").resolve()),
        "thumbnails": [
            str(_thumbnail(out, number).resolve()) for number in spread(range(len(capture.views)), THUMBNAILS)
        ],
        "centre": capture.centre.tolist(),
        "radius": float(capture.radius),
        "lines": lines,
    }


def describe(capture: Capture, thumbnails: Path | None = None) -> list[str]:
    """Describe a capture in lines of text. At the end there are lines `Not used: …` and `Warning: …` for likely mistakes.

    Decodes every photo, mask and prior (normals or depth that another program guessed). Raises InputError if any of these files cannot be
    read. The message gives the number of views with such files, and names the first file. If the folder `thumbnails` is given, thumbnails
    of up to 12 photos are written to it.
    """
    statistics = _decode_all(capture, thumbnails)
    guess = _guessed_box(capture)
    return [
        f"Layout: {LAYOUTS[capture.layout]}",
        f"Views: {len(capture.views)}, {len(capture.train_views)} to train on, {len(capture.test_views)} to test on",
        _sizes(capture),
        _lenses(capture),
        _masks(capture, statistics),
        *_priors(capture),
        *_guessed_object(guess),
        _poses(capture),
        _extent(capture),
        _taken_for(capture, guess),
        *(f"Not used: {one_line(what)}" for what in not_used(capture)),
        *(f"Warning: {one_line(warning)}" for warning in [*capture.warnings, *_warnings(capture, statistics)]),
    ]


class _Statistics:
    """Hold statistics of one photo. If it has a mask, only pixels inside the mask are measured.

    `coverage` is the fraction of pixels inside the mask, None without a mask. `clipped` is the fraction of clipped pixels. `brightness` is
    the mean of the 8-bit values, and `brightest` their 99th percentile. `grey` is True if the photo has no colour. `sharpness` comes from
    `_sharpness`. `inverted` is True if the mask is white in the corners, but black on a quarter or more of the middle.
    """

    def __init__(self, loaded: LoadedView):
        inside = np.ones(loaded.image.shape[:2], bool) if loaded.alpha is None else loaded.alpha > 127
        shown = loaded.bytes
        pixels = shown[inside] if inside.any() else np.zeros((1, 3), np.uint8)
        self.coverage = None if loaded.alpha is None else float(inside.mean())
        self.inverted = loaded.alpha is not None and _is_inverted(inside)
        self.clipped = float(np.any(loaded.clipped, axis=2)[inside].mean()) if inside.any() else 0.0
        self.brightness, self.brightest = float(pixels.mean()), float(np.percentile(pixels, 99))
        self.grey = bool((pixels.max(axis=1) == pixels.min(axis=1)).all())
        self.sharpness = _sharpness(shown, inside)


def _is_inverted(inside: np.ndarray) -> bool:
    height, width = inside.shape
    top, left = height // 50, width // 50  # not the very corners, which show nothing if distortion was removed
    corners = inside[np.ix_([top, height - 1 - top], [left, width - 1 - left])]
    middle = inside[height // 4 : height - height // 4, width // 4 : width - width // 4]
    return bool(corners.all() and middle.mean() <= 0.75)


def _sharpness(image: np.ndarray, inside: np.ndarray) -> float:
    """Measure sharpness inside the mask, independent of contrast; a uniform image has 0."""
    # The sum of the squared Laplacian over the sum of the squared gradient.
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    inside = cv2.erode(inside.astype(np.uint8), np.ones((7, 7), np.uint8), borderValue=(0,)) > 0
    across, down = (cv2.Sobel(grey, cv2.CV_32F, *axis, scale=1 / 8)[inside] for axis in ((1, 0), (0, 1)))
    gradient = float((across**2 + down**2).sum())
    return float((cv2.Laplacian(grey, cv2.CV_32F)[inside] ** 2).sum()) / gradient if gradient > 0 else 0.0


def _thumbnail(folder: Path, number: int) -> Path:
    return folder / f"{number:04d}.png"


def _write_thumbnail(file: Path, loaded: LoadedView) -> None:
    pixels = loaded.bytes if loaded.alpha is None else np.dstack([loaded.bytes, loaded.alpha])
    picture = Image.fromarray(pixels)
    picture.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE))
    with whole(file) as temporary:
        picture.save(temporary, "PNG")


def _decode_all(capture: Capture, thumbnails: Path | None) -> list[_Statistics]:
    statistics, broken = [], []
    shown = spread(range(len(capture.views)), THUMBNAILS) if thumbnails else []
    for number, view in enumerate(capture.views):
        try:
            loaded = load_view(view, 512)
            load_normals(view)
            load_depth(view)
        except InputError as error:
            broken.append(str(error))
            continue
        statistics.append(_Statistics(loaded))
        if thumbnails is not None and number in shown:
            _write_thumbnail(_thumbnail(thumbnails, number), loaded)
    if broken:
        count = f"{len(broken)} of {len(capture.views)} views cannot be read, the first: " if len(broken) > 1 else ""
        raise InputError(count + broken[0])
    return statistics


def _sizes(capture: Capture) -> str:
    sizes = Counter((view.camera.width, view.camera.height) for view in capture.views).most_common()
    named = ", ".join(f"{width}×{height}" + (f" ({n})" if len(sizes) > 1 else "") for (width, height), n in sizes[:4])
    return f"Sizes: {named} pixels" + (f" and {len(sizes) - 4} other sizes" if len(sizes) > 4 else "")


def _lenses(capture: Capture) -> str:
    angles = [2 * np.degrees(np.arctan(view.camera.width / 2 / view.camera.fx)) for view in capture.views]
    distorted = sum(view.lens is not None for view in capture.views)
    line = f"Lens: {_span(angles, '.1f')}° wide"
    return line + (f", distortion removed from {distorted} views on loading" if distorted else ", no distortion")


def _masks(capture: Capture, statistics: list[_Statistics]) -> str:
    coverage = [s.coverage for s in statistics if s.coverage is not None]
    if not coverage:
        return "Masks: none"
    from refgs.capture.masks import count_made  # imports scipy, which a wrong folder should not wait for

    made, files = count_made(capture), sum(view.mask_path is not None for view in capture.views)
    counts = {"made by RefGS": made, "mask files": files - made, "the photos' alpha": len(coverage) - files}
    found = {kind: count for kind, count in counts.items() if count}
    kinds = ", ".join(f"{kind}: {count}" if len(found) > 1 else kind for kind, count in found.items())
    return (
        f"Masks: {len(coverage)} views ({kinds}), covering {_span([100 * c for c in coverage], '.0f')} % of the picture"
    )


def _priors(capture: Capture) -> list[str]:
    """Return lines that count training photos with other programs' normals and depth."""
    lines = []
    for name, field in FOLDERS.items():
        if count := sum(getattr(view, field) is not None for view in capture.train_views):
            lines.append(f"{name.capitalize()}: for {count} of {len(capture.train_views)} views to train on")
    return lines


def _guessed_box(capture: Capture) -> Box | None:
    """Return the guessed box in which a training would look for the object, or None."""
    # It makes no masks if a photo has one, or if the cameras look outwards.
    if any(view.masked for view in capture.views) or capture.box is not None:
        return None
    from refgs.capture.masks import guess_box  # imports scipy, as above

    try:
        return guess_box(capture, capture.views)[0]
    except InputError:
        return None


def _guessed_object(guess: Box | None) -> list[str]:
    if guess is None:
        return []
    from refgs.capture.masks import region_settings

    where = " ".join(region_settings(guess))
    return [f"Object: not masked. refgs train and refgs masks look for it in the box {where}, a guess"]


def _taken_for(capture: Capture, guess: Box | None) -> str:
    """Return a line that says what the capture is taken for, why, and what follows for a training. `guess` is from `_guessed_box`."""
    is_object = capture.bounded or capture.bounded_because == ONE_SIDED
    if capture.masked:
        follows = "what is outside the masks is not reconstructed"
    elif any(view.masked for view in capture.views):
        follows = "what is around it in photos without a mask is reconstructed, too"
    elif guess is None:
        follows = "no masks are made, and all that the photos show is reconstructed"
    else:
        still = "makes masks of it first" if is_object else "looks for an object all the same, to mask it"
        follows = f"refgs train {still}, and leaves out its surroundings; it keeps them with --set image.masks=off"
    kind = "an object" if is_object else "a room or open scene"
    return f"Taken for {kind}: {capture.bounded_because}. So {follows}"


def _poses(capture: Capture) -> str:
    offset = np.array([view.camera.position for view in capture.views]) - capture.centre
    distance = np.linalg.norm(offset, axis=1)
    elevation = np.degrees(np.arcsin(np.clip(offset[:, 2] / np.maximum(distance, 1e-12), -1, 1)))
    azimuth = np.sort(np.degrees(np.arctan2(offset[:, 1], offset[:, 0])))
    gap = np.diff(np.append(azimuth, azimuth[0] + 360)).max()
    return (
        f"Poses: {_span(distance / capture.radius, '.2g')} radii from the centre, {_span(elevation, '.0f')}° above it, "
        f"{360 - gap:.0f}° around it"
    )


def _extent(capture: Capture) -> str:
    centre = capture.to_capture @ np.append(capture.centre, 1)
    radius = capture.radius * np.cbrt(np.linalg.det(capture.to_capture[:3, :3]))
    x, y, z = np.round(centre[:3], 2 - math.floor(math.log10(radius))) + 0.0  # a hundredth of the radius; no −0
    line = f"Extent: radius {radius:.3g} about ({x:.15g}, {y:.15g}, {z:.15g}) in the capture's frame"
    return line if capture.points is None else f"{line}, {len(capture.points):,} structure-from-motion points"


def _warnings(capture: Capture, statistics: list[_Statistics]) -> list[str]:
    warnings = []

    def count(what: str, views: list[View], advice: str) -> None:
        if views:
            first = views[0].image_path.name
            warnings.append(f"{len(views)} of {len(capture.views)} views {what}, first {first}: {advice}")

    pairs = list(zip(capture.views, statistics, strict=True))
    if any(view.masked for view in capture.views):
        unmasked = [view for view in capture.views if not view.masked]
        count("have no mask", unmasked, "make them masks, or remove the photos")
    empty = [view for view, s in pairs if s.coverage == 0]
    count("have an empty mask", empty, "make the masks anew, or remove the photos")
    if inverted := [view.mask_path or view.image_path for view, s in pairs if s.inverted]:
        first = Path(os.path.relpath(inverted[0], capture.folder)).as_posix()
        what = (
            f"{len(inverted)} of {len(capture.views)} masks look inverted, white in the corners and black in the middle"
        )
        warnings.append(f"{what}, first {first}: invert them, so that the object is white and the rest black")
    grey = [view for view, s in pairs if s.grey and s.coverage != 0]
    count("are greyscale", grey, "put the photos in colour in their place")
    clipped = [view for view, s in pairs if s.clipped > 0.1]
    count("are clipped to white over a tenth of the subject", clipped, "photograph it again, exposed less")
    usual = np.median([s.sharpness for s in statistics if s.sharpness > 0] or [0])
    blurred = [view for view, s in pairs if 0 < s.sharpness < BLURRED * usual]
    count("look blurred beside the others", blurred, "look at them, and remove or retake those that are")
    outwards = capture.bounded_because == LOOK_OUT  # as from a room's middle, which none of them needs to see
    astray = [view for view in capture.views if not outwards and not _sees(view, capture.centre)]
    count("do not see the centre", astray, "where their cameras are wrong, or they show something else, remove them")
    brightness = [s.brightness for s in statistics if s.coverage != 0]
    if brightness and max(brightness) > 2 * max(1.0, np.median(brightness)):
        brightest = max(pairs, key=lambda pair: pair[1].brightness)[0].image_path.name
        what = f"exposure varies: {brightest} is more than twice as bright as most"
        warnings.append(f"{what}: the training allows for it, but photos with the exposure locked are better")
    linear = [s for view, s in pairs if view.image_path.suffix.lower() == ".exr" and s.coverage != 0]
    black = bool(linear) and np.median([s.brightest for s in linear]) < BLACK
    if black or (linear and np.median([s.brightness for s in linear]) > WHITE):
        what = f"EXR photos are almost {'black' if black else 'white'}"
        warnings.append(f"{what}: multiply all of them by the same factor, so that a white surface is about 1")
    if len(capture.train_views) < 20:
        warnings.append(f"{len(capture.train_views)} training views are few: take more, thirty or more are good")
    return warnings


def _sees(view: View, point: np.ndarray) -> bool:
    camera = view.camera
    x, y, z = camera.world_to_camera[:3, :3] @ point + camera.world_to_camera[:3, 3]
    if z <= 0:
        return False
    return 0 <= camera.fx * x / z + camera.cx <= camera.width and 0 <= camera.fy * y / z + camera.cy <= camera.height


def _span(values, layout: str) -> str:
    low, high = format(min(values), layout), format(max(values), layout)
    return low if low == high else f"{low} to {high}"
