"""Make masks for a capture that has cameras but no masks, and remake them when an artist's strokes change.

Strokes are an artist's corrections: pictures CAPTURE/strokes/NAME.png with transparency, drawn on the upright photo. White marks the
object, black marks the background, and transparent pixels say nothing. The hashes of masks that the program made are in masks/made.json.
All other masks are the artist's: they are kept, and help to find the object in the other photos.
"""

import hashlib
import json
import os
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from pydantic import TypeAdapter

from refgs.capture import View, read_files, to_run_frame
from refgs.capture.backdrop import Backdrop, find_plane
from refgs.capture.box import Box
from refgs.capture.cameras import mask_names
from refgs.capture.colmap import capture_root
from refgs.capture.photo_parts import FINE, Part, find_judge, inner_path, load_ahead, stroke_file, to_photo
from refgs.capture.region import LOOK_OUT, WHITE_MASKS, find_region, sample_silhouettes, up_direction
from refgs.capture.silhouettes import Photo, carve_object, cut_out, find_box
from refgs.capture.triangulate import triangulate
from refgs.capture.types import Capture, CaptureFiles
from refgs.errors import InputError
from refgs.events import Report
from refgs.paths import hash_file, read_text, write_text
from refgs.settings import RegionSettings
from refgs.spread import spread

SIDE = 256  # pixels on the longer side of the part that shows the object, for carving
CARVED_BY = 60  # photos at most
FOUND_BY = 16  # photos at most, in which the object is looked for as a whole, to find the box around it
MADE = "made.json"
_HASHES = TypeAdapter(set[str])  # what is in it


class ReadOnlyError(InputError):
    """Error for a capture that gets no masks, because its folder cannot be written to."""


def make_masks(
    folder: Path,
    wanted: RegionSettings | None,
    report: Report,
    model: Path | None = None,
) -> dict[str, Any]:
    """Make the masks of a capture's photos, and write them to its folder `masks`.

    `wanted` may set a box around the object, as for `read_capture`. Its up direction is not used. Without a box, the object is guessed
    (`guess_box`), and the guess is reported as the event "region". `report(event, facts)` is also called with "progress" and "warning".
    `model` is an ONNX file (`SalienceModel`) that finds the object's pixels in place of RefGS's own, MODEL. Without any, the object is
    found by colours, and "region" says so.

    Returns a dict:

    - `photos`, `made`, `kept`: the numbers of photos, of new masks and of kept masks.
    - `objects`: the number of separate objects.
    - `masks`: the mask file of each photo that has one, by the photo's path. Paths are in the capture's folder, or absolute.
    - `region`: the box around the objects, as settings for a training with the new masks.
    - `moved`: a matrix (4, 4), as a list of rows: p_new = moved @ p. The run's frame (the world coordinates of training) depends on the
      masks. The matrix maps points from the frame with the earlier masks to the frame with the new masks.

    All masks are written together at the end. An interrupted call leaves the earlier masks. Raises InputError if the artist has made all
    masks already, if the artist's masks are all white, if strokes do not fit their photo, if the model cannot be used, or if no object is
    found. Raises ReadOnlyError if the folder cannot be written to.
    """
    return with_masks(read_files(folder), wanted, report, model)[1]


def with_masks(
    files: CaptureFiles,
    wanted: RegionSettings | None,
    report: Report,
    model: Path | None = None,
) -> tuple[CaptureFiles, dict[str, Any]]:
    """Make masks as `make_masks` does, for a capture that `read_files` has read.

    Return `files` with the new masks, and the dict that `make_masks` returns.
    """
    folder = files.folder
    judge = find_judge(model)
    capture = to_run_frame(files, wanted and wanted.model_copy(update={"up": (0.0, 0.0, 0.0)}))
    root = capture_root(folder, capture.layout)
    _check_writable(root)
    made = _hashes(root)
    if WHITE_MASKS in capture.warnings:
        _check_white(files, made)
    views = [replace(view, mask_path=None) if _is_made(view, made) else view for view in capture.views]
    if all(view.masked for view in views):
        raise InputError(f"{folder}: every photo has a mask that was not made here. Remove those that you want made.")
    targets = _targets(root, views)
    for target in targets.values():
        if target.exists() and _hash(target) not in made:
            raise InputError(f"{target} was not made here, and the photos' masks are not used: remove them")
    chosen = _choose(views, root)

    def reading(done: int, total: int) -> None:
        report("progress", {"stage": "points", "done": done, "total": total})

    def load(parts: list[Part], stage: str) -> list[Photo]:
        photos = []
        for photo in load_ahead(parts, root, judge):
            photos.append(photo)
            report("progress", {"stage": stage, "done": len(photos), "total": len(parts)})
        return photos

    if capture.box:
        box, fill, size = capture.box, 0.9, capture.box.radius / 3**0.5
    else:
        box, fill, size = guess_box(capture, views)
        guessed = region_settings(box)
        what = f"looking for the object in the box {' '.join(guessed)}"
        if judge is None:
            what += ", by its colours: python scripts/fetch_model.py brings a model that knows objects"
        report("region", {"region": guessed, "what": what})
    points = triangulate(chosen, reading) if capture.points is None else capture.points
    positions = np.array([view.camera.position for view in views])
    plane = find_plane(points, box.centre, size, up_direction(views), positions)
    backdrop = None if plane is None else Backdrop(plane, box.centre, size)
    if judge is not None and not capture.box:
        box = find_box(load([Part.whole(view, SIDE) for view in spread(chosen, FOUND_BY)], "looking"), box)
    photos = load([Part.around(box, view, SIDE, root) for view in chosen], "reading")

    def carving(done: int, total: int) -> None:
        report("progress", {"stage": "carving", "done": done, "total": total})

    nothing = InputError(
        f"{folder}: no object was found. Set a box about it (region.size), or draw strokes on some photos."
    )
    shape = carve_object(photos, box, fill, backdrop, carving)
    if shape is None:
        raise nothing
    if shape.objects > 1:
        report("warning", {"what": f"{shape.objects} separate objects are in the box: all of them are in the masks"})
    work = root / "masks.tmp"
    shutil.rmtree(work, ignore_errors=True)
    try:
        drawn, found = {}, False
        parts = [Part.around(box, view, FINE, root) for view in targets]
        for part, photo, target in zip(parts, load_ahead(parts, root, judge), targets.values(), strict=True):
            mask = to_photo(part.view, part.paste(cut_out(photo, shape)))
            found |= bool(mask.any())
            path = work / target.relative_to(root)
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(mask).save(path)
            drawn[path] = target
            report("progress", {"stage": "edges", "done": len(drawn), "total": len(targets)})
        if not found and len(targets) == len(views):
            raise nothing
        masked = {target: path for path, target in drawn.items()}
        final = [replace(v, mask_path=masked[targets[v]]) if v in targets else v for v in views]
        if not find_region(final, up_direction(final), None, sample_silhouettes(final)).bounded:
            raise nothing  # the masks do not agree on a solid object
        _put(drawn, root, made)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    given = [
        replace(read, mask_path=targets[view], has_alpha=False) if view in targets else read
        for read, view in zip(files.views, views, strict=True)
    ]
    files = files._replace(views=given)
    to_frame = np.linalg.inv(to_run_frame(files).to_capture) @ capture.to_capture
    return files, {
        "photos": len(views),
        "made": len(targets),
        "kept": len(views) - len(targets),
        "objects": shape.objects,
        "masks": mask_names(folder, given),
        "region": region_settings(shape.bounds(to_frame)),
        "moved": to_frame.tolist(),
    }


def guess_box(capture: Capture, views: list[View]) -> tuple[Box, float, float]:
    """Guess a box around the object: a cube around the point at which the cameras look.

    The guess uses the cameras of `views` and the capture's point cloud, but no masks. Returns three values:

    - the box, in the coordinates of these cameras
    - the likely size of the object, as a fraction of the box's edge length
    - the radius of the region of interest, in the units of these cameras

    Raises InputError if the cameras look outwards, as in a room.
    """
    found = find_region(views, up_direction(views), capture.points, [])
    if found.because == LOOK_OUT:
        raise InputError(
            f"{capture.folder}: the cameras look outwards, not at an object. Set a box about one (region.size)."
        )
    matrix = np.eye(4)
    matrix[:3, :3] *= 1.25 * found.radius
    matrix[:3, 3] = found.centre
    return Box(matrix), 0.8, found.radius


def region_settings(box: Box) -> list[str]:
    """Return a box as two settings, "region.centre=[…]" and "region.size=[…]". The box's edges must be parallel to the axes."""
    size = 2 * np.linalg.norm(box.matrix[:3, :3], axis=0)
    return [
        f"region.{key}={[round(float(x), 4) + 0.0 for x in values]}"
        for key, values in (("centre", box.centre), ("size", size))
    ]


def moved_region(wanted: RegionSettings, moved: list[list[float]]) -> RegionSettings:
    """Convert the box `wanted` to the run's frame that results from new masks. `moved` (4, 4) is in the dict that `make_masks` returns."""
    scale = sum(row[0] ** 2 for row in moved[:3]) ** 0.5
    centre = tuple(sum(a * b for a, b in zip(row, (*wanted.centre, 1.0), strict=True)) for row in moved[:3])
    return wanted.model_copy(update={"centre": centre, "size": tuple(scale * edge for edge in wanted.size)})


def masks_folder(capture: Capture) -> Path:
    """Return the folder for a capture's masks."""
    return capture_root(capture.folder, capture.layout) / "masks"


def count_made(capture: Capture) -> int:
    """Count the views whose masks were made here, and not changed since. The hashes in masks/made.json tell."""
    made = _hashes(capture_root(capture.folder, capture.layout))
    return sum(_is_made(view, made) for view in capture.views) if made else 0


def _is_made(view: View, made: set[str]) -> bool:
    return view.mask_path is not None and _hash(view.mask_path) in made


def _check_writable(root: Path) -> None:
    # A folder whose owner took away the right to write is left alone, even where this process could write to it.
    if not os.access(root, os.W_OK) or not root.stat().st_mode & 0o222:
        raise ReadOnlyError(f"{root} is read-only: masks cannot be written to it. Copy the capture.")


def _check_white(files: CaptureFiles, made: set[str]) -> None:
    masks = [view.mask_path for view in files.views if view.mask_path is not None]
    given = [file for file in masks if _hash(file) not in made]
    if given:
        raise InputError(
            f"{given[0].parent}: all {len(given)} masks are white (opaque) everywhere, {given[0].name} too. "
            "Delete them, and refgs masks makes new ones."
        )


def _targets(root: Path, views: list[View]) -> dict[View, Path]:
    """Map each photo without a mask to its mask file NAME.png, or to NAME.jpg.png if photos differ only in their suffix."""
    inner = [inner_path(view, root) for view in views]
    twice = Counter(inner)  # as cam1/1.jpg and cam2/1.jpg without a folder images above
    names = [name if twice[name] == 1 else v.image_path.relative_to(root) for name, v in zip(inner, views, strict=True)]
    stems = Counter(name.with_suffix("") for name in names)
    files = (
        name.with_suffix(".png") if stems[name.with_suffix("")] == 1 else name.with_name(name.name + ".png")
        for name in names
    )
    return {view: root / "masks" / file for view, file in zip(views, files, strict=True) if not view.masked}


def _hash(path: Path) -> str:
    return hash_file(path, hashlib.sha256).hexdigest()


def _hashes(root: Path) -> set[str]:
    try:
        return _HASHES.validate_json(read_text(root / "masks" / MADE, ""))
    except (InputError, ValueError):  # without it, every mask is the artist's
        return set()


def _choose(views: list[View], root: Path) -> list[View]:
    """Choose the photos for carving the object: some evenly spaced photos, and all photos that have the artist's mask or strokes."""
    every = max(1, -(-len(views) // CARVED_BY))
    return [view for i, view in enumerate(views) if i % every == 0 or view.masked or stroke_file(view, root)]


def _put(files: dict[Path, Path], root: Path, before: set[str]) -> None:
    """Move the new masks to their places, and record their hashes in masks/made.json.

    `files` maps each temporary file to its place. `before` are the hashes recorded so far. They stay recorded, together with the new ones,
    until all masks are moved. So after an interruption, no mask of the program is taken for the artist's.
    """
    (root / "masks").mkdir(exist_ok=True)
    now = {_hash(path) for path in files}
    write_text(root / "masks" / MADE, json.dumps(sorted(before | now)))
    for path, target in files.items():
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(path, target)
    write_text(root / "masks" / MADE, json.dumps(sorted(now)))
