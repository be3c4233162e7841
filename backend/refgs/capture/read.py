"""Find a capture's file layout, read its photos' cameras, and convert them to the run's frame (the world coordinates of training)."""

import hashlib
import os
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from refgs.capture.box import Box
from refgs.capture.colmap import capture_root, find_model, read_colmap
from refgs.capture.files import Files, find_photos, photos_in
from refgs.capture.nerf_blender import read_nerf_blender
from refgs.capture.nerfstudio import read_nerfstudio
from refgs.capture.nero import read_nero
from refgs.capture.poses import in_frame
from refgs.capture.priors import with_priors
from refgs.capture.region import (
    WHITE_MASKS,
    Region,
    find_region,
    is_near,
    region_in,
    run_frame,
    sample_silhouettes,
    up_direction,
    warn_of_axes,
)
from refgs.capture.stanford_orb import NOVEL, read_stanford_orb
from refgs.capture.tensoir import is_tensoir, read_tensoir
from refgs.capture.types import Z_UP, Capture, CaptureFiles, View
from refgs.errors import InputError, NoCameras
from refgs.paths import check_folder, check_unicode, command_line
from refgs.settings import RegionSettings


def find_layout(folder: Path) -> str | None:
    """Return the layout of a folder's camera files, such as "nerf-blender", or None."""
    if is_tensoir(folder):  # first, because copies of the data set have a transforms_train.json, too
        return "tensoir"
    if (folder / "transforms_train.json").is_file():
        return "stanford-orb" if (folder / NOVEL).is_file() else "nerf-blender"
    if (folder / "transforms.json").is_file():
        return "nerfstudio"
    if find_model(folder) is not None:
        return "colmap"
    return "nero" if (folder / "0-camera.pkl").is_file() else None


def read_capture(folder: Path, wanted: RegionSettings | None = None) -> Capture:
    """Read the photos' cameras from a capture's folder, and convert them to the run's frame, the world coordinates used in training.

    `wanted` may set a box around the part to reconstruct, and an up direction. Give both in the run's frame that results from a call
    without `wanted`. Only the photos' headers and some masks are read; photos are not decoded.
    Raises InputError with a message of one line.
    """
    return to_run_frame(read_files(folder), wanted)


def read_files(folder: Path) -> CaptureFiles:
    """Read a capture's files, without decoding pixels, in its own coordinates. Raises InputError."""
    folder = Path(folder)
    layout = _check_layout(folder)
    views, points, colors, warnings = _read(folder, layout)
    _check_photos(views)
    shared = _shared_photos(views)
    views = _hold_out(views)
    _check_cameras(folder, views)
    views = _unique_names(views)
    views = with_priors(views, capture_root(folder, layout))
    return CaptureFiles(folder, layout, views, points, colors, [*warnings, *shared])


def to_run_frame(files: CaptureFiles, wanted: RegionSettings | None = None) -> Capture:
    """Convert a capture that `read_files` has read to the run's frame (the world coordinates of training).

    `wanted` may set a box and an up direction, as for `read_capture`. Some masks are read, to find the region of interest.
    """
    folder, layout, points = files.folder, files.layout, files.points
    views, silhouettes, white = _silhouettes(files.views)
    up = up_direction(views)
    region = find_region(views, up, points, silhouettes)
    to_capture, unit = _run_frame(layout, region, up)
    box, reach = None, region.radius
    if wanted is not None and any(wanted.size):
        box = Box.of(wanted).moved(to_capture)
        region, reach = _narrow(region, box, views, silhouettes)
    if wanted is not None and any(wanted.up):
        to_capture = to_capture @ run_frame(np.array(wanted.up) / np.linalg.norm(wanted.up), np.zeros(3), 1.0)
    capture = Capture(
        folder=folder,
        layout=layout,
        views=views,
        to_capture=to_capture,
        points=points,
        point_colors=files.colors,
        bounded=region.bounded,
        bounded_because=region.because,
        centre=region.centre,
        radius=region.radius,
        reach=reach,
        box=box,
        digest=_digest(folder, layout, views),
        warnings=[*files.warnings, *white, *warn_of_axes(layout, views)],
    )
    return capture if np.array_equal(to_capture, np.eye(4)) else _in_run_frame(capture, unit)


def _check_layout(folder: Path) -> str:
    """Return the folder's layout. Raises InputError without a capture, NoCameras for photos alone."""
    check_folder(folder)
    layout = find_layout(folder)
    if layout is not None:
        return layout
    if photos := find_photos(folder):
        search = command_line("refgs", "poses", folder)
        raise NoCameras(f"{folder}: {len(photos)} photos, but no cameras. Find them first: {search}")
    files = Files(folder)
    if inner := [path.name for path in files.folders(folder) if photos_in(files, path, deep=True)]:
        where = f"in {inner[0]}" if len(inner) == 1 else f"in {len(inner)} folders, first {inner[0]}"
        raise InputError(
            f"{folder} is not a capture, but there are photos {where}. Name the one that is a capture; "
            "if they are photos of one object, put their folders into a folder images."
        )
    raise InputError(
        f"{folder} is not a capture: no photos are in it or in its folder images. Name the folder that holds them. "
        "Cameras are read from transforms_train.json (NeRF-Blender, Stanford-ORB), transforms.json (nerfstudio, instant-ngp), "
        "sparse/0 and the like (COLMAP), 0-camera.pkl (NeRO) and train_000/metadata.json (TensoIR)."
    )


def _read(folder: Path, layout: str) -> tuple[list[View], np.ndarray | None, np.ndarray | None, list[str]]:
    """Read a capture's views, points, points' colours, and warnings, by its layout's reader."""
    match layout:
        case "nerf-blender":
            views, warnings = read_nerf_blender(folder)
            return views, None, None, warnings
        case "stanford-orb":
            views, warnings = read_stanford_orb(folder)
            return views, None, None, warnings
        case "tensoir":
            views, warnings = read_tensoir(folder)
            return views, None, None, warnings
        case "nerfstudio":
            return read_nerfstudio(folder)
        case "colmap" if (model := find_model(folder)) is not None:
            return read_colmap(model)
    views, warnings = read_nero(folder)
    return views, None, None, warnings


def _check_photos(views: list[View]) -> None:
    for (_, path), count in Counter((view.split, view.image_path) for view in views).items():
        if count > 1:
            raise InputError(f"{path}: the capture names this photo {count} times. Remove all of its frames but one.")
        check_unicode(path)


def _shared_photos(views: list[View]) -> list[str]:
    """Return a warning if photos are both training and test views, otherwise []."""
    tested, trained = ({view.image_path for view in views if view.split == split} for split in ("test", "train"))
    shared = tested & trained
    if not shared:
        return []
    twice = f"{len(shared)} photos are both trained and tested on, first {min(shared).name}"
    return [f"{twice}: the figures will be too good; name each in one of the two files"]


def _hold_out(views: list[View]) -> list[View]:
    """Make every eighth view by path a test view, unless there are test views."""
    if any(view.split == "test" for view in views):
        return views
    views = sorted(views, key=lambda view: view.image_path.as_posix())
    return [replace(view, split="train" if i % 8 else "test") for i, view in enumerate(views)]


def _check_cameras(folder: Path, views: list[View]) -> None:
    train = [view for view in views if view.split == "train"]
    if len(train) < 3:
        raise InputError(
            f"{folder}: {len(train)} training views (of {len(views)}; the rest are held out for testing). "
            "At least three are needed, thirty or more are good: add photos."
        )
    positions = np.array([view.camera.position for view in train])
    # Relative to float64's resolution, not to the distance from the origin: map coordinates have an origin far away.
    if np.ptp(positions, axis=0).max() <= 1e-12 * max(1.0, np.abs(positions).max()):
        raise InputError(f"{folder}: all cameras are in one place, so no depth can be seen. Photograph from around it.")


def _unique_names(views: list[View]) -> list[View]:
    """Make cameras' names unique within each split by paths. Raises InputError if impossible."""
    names = Counter((view.split, view.camera.name) for view in views)
    # Absolute, because a camera file may give some photos by absolute paths.
    top = os.path.commonpath([os.path.abspath(view.image_path.parent) for view in views])

    def name(view: View) -> str:
        if names[view.split, view.camera.name] == 1:
            return view.camera.name
        return Path(os.path.relpath(view.image_path, top)).with_suffix("").as_posix().replace("/", "_")

    views = [replace(view, camera=replace(view.camera, name=name(view))) for view in views]
    (_, twice), count = Counter((view.split, view.camera.name) for view in views).most_common(1)[0]
    if count > 1:
        raise InputError(f"{top}: {count} photos are named {twice}, with different endings. Rename them apart.")
    return views


def _silhouettes(views: list[View]) -> tuple[list[View], list[tuple[View, np.ndarray]], list[str]]:
    """Return the views, pairs of view and reduced mask, and warnings; drop white masks."""
    silhouettes = sample_silhouettes(views)
    if silhouettes or not any(view.masked for view in views):
        return views, silhouettes, []
    views = [replace(view, mask_path=None, has_alpha=False) for view in views]
    return views, [], [WHITE_MASKS]


def _run_frame(layout: str, region: Region, up: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the similarity (4, 4) from the run's frame to the capture's, and its scale."""
    # A layout of Z_UP keeps its coordinates, unless its region is so far away, large or small that float32 is too inexact.
    if layout in Z_UP:
        if is_near(region):
            return np.eye(4), 1.0
        up = np.array([0.0, 0.0, 1.0])
    return run_frame(up, region.centre, region.radius), region.radius


def _narrow(whole: Region, box: Box, views: list[View], silhouettes: list) -> tuple[Region, float]:
    """Return the region within `box`, and the radius about its centre that contains `whole`."""
    region = region_in(box, views, silhouettes)
    return region, whole.radius + float(np.linalg.norm(whole.centre - region.centre))


def _in_run_frame(capture: Capture, unit: float) -> Capture:
    """Convert a capture to the run's coordinates; one run unit is `unit` capture units."""
    to_run = np.linalg.inv(capture.to_capture)
    points = capture.points
    return replace(
        capture,
        views=[replace(view, camera=in_frame(view.camera, to_run)) for view in capture.views],
        points=None if points is None else points @ to_run[:3, :3].T + to_run[:3, 3],
        box=None if capture.box is None else capture.box.moved(to_run),
        centre=to_run[:3, :3] @ (capture.centre - capture.to_capture[:3, 3]),
        radius=capture.radius / unit,
        reach=capture.reach / unit,
    )


def _digest(folder: Path, layout: str, views: list[View]) -> str:
    digest = hashlib.sha256(layout.encode())
    for view in views:
        camera = view.camera
        digest.update(f"{camera.name} {view.split}".encode())
        for path in (view.image_path, view.mask_path):
            if path is not None:
                digest.update(f" {Path(os.path.relpath(path, folder)).as_posix()} {path.stat().st_size}".encode())
        numbers = [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]
        # Rounded, because the last bits differ between processors.
        digest.update((np.round([*numbers, *camera.world_to_camera.ravel()], 6) + 0.0).tobytes())
    return digest.hexdigest()
