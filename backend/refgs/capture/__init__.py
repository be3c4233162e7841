"""From a folder on disk to cameras and images: one module a layout."""

import hashlib
import os
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from refgs.capture.box import Box
from refgs.capture.cameras import read_cameras, read_run_cameras, write_cameras
from refgs.capture.colmap import find_model, read_colmap
from refgs.capture.files import find_photos
from refgs.capture.images import LoadedView, load_view
from refgs.capture.nerf_blender import published_normals, read_nerf_blender
from refgs.capture.nerfstudio import read_nerfstudio
from refgs.capture.nero import read_nero
from refgs.capture.poses import in_frame
from refgs.capture.region import find_region, is_near, region_in, run_frame, sample_silhouettes, up_direction
from refgs.capture.types import Capture, View
from refgs.errors import InputError, NoCameras
from refgs.settings import RegionSettings

__all__ = [
    "Box",
    "Capture",
    "LoadedView",
    "View",
    "find_layout",
    "load_view",
    "published_normals",
    "read_cameras",
    "read_capture",
    "read_run_cameras",
    "write_cameras",
]


def find_layout(folder: Path) -> str | None:
    """The layout of the cameras in a folder, by its name in `Capture.layout`; None where there are no cameras."""
    if (folder / "transforms_train.json").is_file():
        return "nerf-blender"
    if (folder / "transforms.json").is_file():
        return "nerfstudio"
    if find_model(folder) is not None:
        return "colmap"
    return "nero" if (folder / "0-camera.pkl").is_file() else None


def read_capture(folder: Path, wanted: RegionSettings | None = None) -> Capture:
    """Reads the cameras of a capture, whatever its layout, and works out the run's frame.

    `wanted` is the part of it that is wanted and which way is up, if that was said, in the frame that it would have without. Photos
    are not decoded, only their headers read, and some masks. Raises InputError, one line for the artist.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder. Name the folder that holds the capture.")
    points = colors = None
    warnings = []
    layout = find_layout(folder)
    match layout:
        case "nerf-blender":
            views = read_nerf_blender(folder)
        case "nerfstudio":
            views, points, colors, warnings = read_nerfstudio(folder)
        case "colmap":
            views, points, colors = read_colmap(*find_model(folder))
        case "nero":
            views, warnings = read_nero(folder)
        case None:
            if photos := find_photos(folder):
                raise NoCameras(
                    f"{folder}: {len(photos)} photos, but no cameras. Find them first: refgs poses {folder}"
                )
            raise InputError(
                f"{folder}: no capture here. Looked for transforms_train.json (NeRF-Blender), transforms.json (nerfstudio, "
                "instant-ngp), sparse/0 (COLMAP), 0-camera.pkl (NeRO), and for photos, here and in images. "
                "Name the folder that holds them."
            )
    photos = Counter((view.split, view.image_path) for view in views)
    for (_, path), count in photos.items():
        if count > 1:
            raise InputError(f"{path}: the capture names this photo {count} times. Remove all of its frames but one.")
    shared = {path for split, path in photos if split == "test"} & {path for split, path in photos if split == "train"}
    if shared:
        twice = f"{len(shared)} photos are both trained and tested on, first {min(shared).name}"
        warnings.append(f"{twice}: the figures will be too good; name each in one of the two files")
    views = _hold_out(views)
    _check(folder, views)
    views = _unique_names(views)
    silhouettes = sample_silhouettes(views)
    if not silhouettes and any(view.masked for view in views):
        warnings.append(
            "the masks are white (opaque) everywhere, so they are not used: make them anew, the object white on black"
        )
        views = [replace(view, mask_path=None, has_alpha=False) for view in views]
    up = up_direction(views)
    region = find_region(views, up, points, silhouettes)
    digest = _digest(folder, layout, views)
    # What is at the origin with radius 1: in NeRF-Blender captures whatever is, if its size and place suit float32.
    stays = layout == "nerf-blender" and is_near(region)
    origin, unit = (np.zeros(3), 1.0) if stays else (region.centre, region.radius)
    to_capture = run_frame(np.array([0.0, 0.0, 1.0]) if layout == "nerf-blender" else up, origin, unit)
    box, reach = None, region.radius
    if wanted is not None and any(wanted.size):
        box, whole = Box.of(wanted).moved(to_capture), region
        region = region_in(box, views, silhouettes)
        reach = whole.radius + float(np.linalg.norm(whole.centre - region.centre))
    turned = wanted is not None and any(wanted.up)
    if turned:
        to_capture = to_capture @ run_frame(np.array(wanted.up) / np.linalg.norm(wanted.up), np.zeros(3), 1.0)
    if turned or not stays:
        to_run = np.linalg.inv(to_capture)
        views = [replace(view, camera=in_frame(view.camera, to_run)) for view in views]
        points = None if points is None else points @ to_run[:3, :3].T + to_run[:3, 3]
        box = None if box is None else box.moved(to_run)
        centre = to_run[:3, :3] @ (region.centre - origin)
        region, reach = replace(region, centre=centre, radius=region.radius / unit), reach / unit
    return Capture(
        folder=folder,
        layout=layout,
        views=views,
        to_capture=to_capture,
        points=points,
        point_colors=colors,
        bounded=region.bounded,
        bounded_because=region.because,
        centre=region.centre,
        radius=region.radius,
        reach=reach,
        box=box,
        digest=digest,
        warnings=warnings,
    )


def _hold_out(views: list[View]) -> list[View]:
    """The capture's own split, else every eighth view by name held out for testing."""
    if any(view.split == "test" for view in views):
        return views
    views = sorted(views, key=lambda view: view.image_path.as_posix())
    return [replace(view, split="train" if i % 8 else "test") for i, view in enumerate(views)]


def _unique_names(views: list[View]) -> list[View]:
    """Names that are unique in each split: photos of one name in two folders get their folders in front."""
    names = Counter((view.split, view.camera.name) for view in views)
    top = os.path.commonpath([view.image_path.parent for view in views])

    def name(view: View) -> str:
        if names[view.split, view.camera.name] == 1:
            return view.camera.name
        return Path(os.path.relpath(view.image_path, top)).with_suffix("").as_posix().replace("/", "_")

    views = [replace(view, camera=replace(view.camera, name=name(view))) for view in views]
    (_, twice), count = Counter((view.split, view.camera.name) for view in views).most_common(1)[0]
    if count > 1:
        raise InputError(f"{top}: {count} photos are named {twice}, with different endings. Rename them apart.")
    return views


def _check(folder: Path, views: list[View]) -> None:
    train = [view for view in views if view.split == "train"]
    if len(train) < 3:
        raise InputError(
            f"{folder}: {len(train)} training views (of {len(views)}; the rest are held out for testing). "
            "At least three are needed, thirty or more are good: add photos."
        )
    positions = np.array([view.camera.position for view in train])
    if np.ptp(positions, axis=0).max() <= 1e-6 * np.abs(positions).max():
        raise InputError(f"{folder}: all cameras are in one place, so no depth can be seen. Photograph from around it.")


def _digest(folder: Path, layout: str, views: list[View]) -> str:
    digest = hashlib.sha256(layout.encode())
    for view in views:
        camera = view.camera
        digest.update(f"{camera.name} {view.split}".encode())
        for path in (view.image_path, view.mask_path):
            if path is not None:
                digest.update(f" {Path(os.path.relpath(path, folder)).as_posix()} {path.stat().st_size}".encode())
        numbers = [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]
        # Rounded, because the last bits differ from one processor's arithmetic to another's.
        digest.update((np.round([*numbers, *camera.world_to_camera.ravel()], 6) + 0.0).tobytes())
    return digest.hexdigest()
