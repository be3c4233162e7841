"""Make icons for the Train panel: a training's newest preview, and its PSNR curve.

Blender's layouts name an icon by its number, the argument `icon_value`.
"""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import bpy
import bpy.utils.previews

from ... import jobs

if TYPE_CHECKING:
    import numpy as np

CURVE = 200, 130  # pixels
EDGE, DOT = 4, 3  # pixels: margin, and half a dot's side
GROUND, GRID, LINE, DOTS = (0.0, 0.0, 0.0, 0.25), (1.0, 1.0, 1.0, 0.12), (0.35, 0.65, 1.0, 1.0), (1.0, 0.65, 0.25, 1.0)

_pictures: bpy.utils.previews.ImagePreviewCollection | None = None
_newest: dict[int, str] = {}  # key of the newest preview by the job's serial number
_drawn: dict[int, tuple[int, int]] = {}  # number of points in the drawn curve by the job's serial number


def preview_icon(job: jobs.Job) -> int:
    """Return the icon number of a training's newest preview, or 0 without one."""
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


def curve_icon(job: jobs.Job) -> int:
    """Return the number of an icon with the PSNR curve of a job.

    Returns 0 while the curve has fewer than two points, and if Blender has no window or no numpy.
    """
    if len(job.curve) < 2 or _pictures is None:
        return 0
    key = f"{job.serial} curve"
    shown = _pictures[key] if key in _pictures else _pictures.new(key)
    count = len(job.curve), len(job.held_out)
    if _drawn.get(job.serial) != count:  # the panel is drawn far more often than points arrive
        try:
            pixels = plot(job.curve, job.held_out)
        except ModuleNotFoundError:
            return 0
        _drawn[job.serial] = count
        shown.image_size = CURVE
        shown.image_pixels_float = pixels.ravel().tolist()
    return shown.icon_id


def plot(trained: list[tuple[float, float]], held_out: list[tuple[float, float]]) -> "np.ndarray":
    """Plot PSNR over log time. Returns RGBA pixels (height, width, 4), bottom row first.

    `trained` are points (seconds, PSNR) measured on the training views, drawn as a line. `held_out` are points measured on the held-out
    views, drawn as dots. The grid lines are at 1, 10, 100 … seconds and every 5 dB.
    """
    import numpy as np

    width, height = CURVE
    points = np.array(trained + held_out)
    points[:, 0] = np.log10(points[:, 0].clip(1e-3))
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.maximum(high - low, 1e-6)

    def place(values: "np.ndarray", axis: int) -> "np.ndarray":
        room = CURVE[axis] - 1 - 2 * EDGE
        return np.rint(EDGE + room * (values - low[axis]) / size[axis]).astype(int)

    pixels = np.empty((height, width, 4), np.float32)
    pixels[:] = GROUND
    pixels[:, place(np.arange(math.ceil(low[0]), math.floor(high[0]) + 1), 0)] = GRID
    pixels[place(np.arange(5 * math.ceil(low[1] / 5), high[1] + 1e-6, 5), 1)] = GRID
    line = points[: len(trained)]
    columns = np.arange(EDGE, place(line[-1, 0], 0) + 1)
    x = low[0] + size[0] * (columns - EDGE) / (width - 1 - 2 * EDGE)
    columns, rows = columns[x >= line[0, 0]], place(np.interp(x, *line.T), 1)[x >= line[0, 0]]
    for column, row, before in zip(columns, rows, [rows[0], *rows[:-1]], strict=True):
        pixels[min(row, before) - 1 : max(row, before) + 2, column] = LINE
    for x, y in points[len(trained) :]:
        row, column = place(y, 1), place(x, 0)
        pixels[row - DOT : row + DOT + 1, column - DOT : column + DOT + 1] = DOTS
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
