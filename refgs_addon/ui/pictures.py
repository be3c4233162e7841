"""Pictures for the panels: a training's newest preview, its curve, and thumbnails of files."""

from pathlib import Path

import bpy
import bpy.utils.previews

from .. import jobs

CURVE = 200, 130  # pixels
GROUND, LINE = (0.0, 0.0, 0.0, 0.25), (0.35, 0.65, 1.0, 1.0)

_pictures: bpy.utils.previews.ImagePreviewCollection | None = None
_newest: dict[int, str] = {}  # by a job's id, the key of its newest picture
_drawn: dict[int, int] = {}  # by a job's id, how many points its curve was drawn with


def picture(job: jobs.Job) -> int:
    """The icon of a job's newest preview; 0 where there is none yet."""
    if not job.preview or _pictures is None:
        return 0
    key = f"{job.serial} {job.preview['iteration']}"
    if key not in _pictures:
        if not Path(job.preview["view"]).is_file():
            return 0
        _pictures.load(key, job.preview["view"], "IMAGE")
        _forget(job)
        _newest[job.serial] = key
    return _pictures[key].icon_id


def thumbnail(file: Path, version: int = 0) -> int:
    """The icon of a small picture of a file, which Blender makes beside; 0 where there is none. What is written anew under the same name
    is of another version."""
    if _pictures is None:
        return 0
    key = f"{file} {version}"
    return (_pictures[key] if key in _pictures else _pictures.load(key, str(file), "IMAGE")).icon_id


def curve(job: jobs.Job) -> int:
    """The icon of a picture of PSNR against seconds; 0 where there are too few points."""
    if len(job.curve) < 2 or _pictures is None:
        return 0
    key = f"{job.serial} curve"
    shown = _pictures[key] if key in _pictures else _pictures.new(key)
    if _drawn.get(job.serial) != len(job.curve):  # the panel is drawn far more often than there is news
        _drawn[job.serial] = len(job.curve)
        shown.image_size = CURVE
        shown.image_pixels_float = _plot(job.curve)
    return shown.icon_id


def _plot(points: list[tuple[float, float]]) -> list[float]:
    """RGBA of a line through the points, bottom row first."""
    width, height = CURVE
    first, last, low, high = points[0][0], points[-1][0], min(p for _, p in points), max(p for _, p in points)
    pixels = list(GROUND) * (width * height)
    at, before = 0, None
    for column in range(width):
        while at < len(points) - 1 and points[at][0] < first + (last - first) * column / (width - 1):
            at += 1
        row = round((height - 6) * (points[at][1] - low) / max(high - low, 1e-6)) + 2
        bottom, top = sorted((row, row if before is None else before))
        for y in range(bottom, top + 3):
            pixels[4 * (y * width + column) : 4 * (y * width + column) + 4] = LINE
        before = row
    return pixels


def _forget(job: jobs.Job) -> None:
    if job.serial in _newest:
        del _pictures[_newest.pop(job.serial)]


def register() -> None:
    global _pictures
    _pictures = bpy.utils.previews.new()


def unregister() -> None:
    global _pictures
    bpy.utils.previews.remove(_pictures)
    _pictures = None
    _newest.clear()
    _drawn.clear()
