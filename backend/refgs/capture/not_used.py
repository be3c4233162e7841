"""Find files in a capture's folder that look as if they belonged to it, and parts of its photos, that are not used."""

import re
from pathlib import Path

from refgs.capture.colmap import capture_root
from refgs.capture.files import PHOTO_FOLDERS, Files, fold, photos_in, without_suffix
from refgs.capture.images import has_gain_map
from refgs.capture.mask_files import mask_folders
from refgs.capture.region import WHITE_MASKS
from refgs.capture.types import Capture

_LIKE_MASKS = re.compile(r"mask|matte|alpha|silhouette|segment", re.IGNORECASE)


def not_used(capture: Capture) -> list[str]:
    """List photos without a camera, gain maps, masks that belong to no photo, and masks in folders that are not read.

    Returns a line of text for each kind, with the number of files and an example. Returns [] if there are no such files. Raises InputError
    naming a photo whose header cannot be read.
    """
    files = Files(capture_root(capture.folder, capture.layout))
    lines = []
    if capture.layout != "tensoir" and (photos := _without_camera(capture, files)):
        lines.append(f"{_count(photos, 'photo')} without a camera, first {_name(files, photos[0])}")
    if photos := [view.image_path for view in capture.views if has_gain_map(view.image_path)]:
        what = f"the HDR gain maps of {_count(photos, 'photo')}, first {_name(files, photos[0])}"
        lines.append(f"{what}: they are read as the standard picture")
    if WHITE_MASKS in capture.warnings:  # no view has its mask then
        return lines
    used = {view.mask_path for view in capture.views}
    read = [] if capture.layout in ("nero", "tensoir") else mask_folders(files, [v.image_path for v in capture.views])
    for folder in files.folders(files.folder):
        if folder.suffix == ".tmp":  # ours, of a search for masks that was interrupted
            continue
        masks = list(files.all_images(folder)) if folder in read or _LIKE_MASKS.search(folder.name) else []
        others = [mask for mask in masks if mask not in used]
        if others and folder in read:
            what = f"{_count(others, 'mask')} of no photo with a camera, first {_name(files, others[0])}"
            lines.append(f"{what}: give masks their photos' names")
        elif others and len(others) == len(masks):
            what = f"{_count(others, 'picture')} in {folder.name}, which may be masks, first {others[0].name}"
            lines.append(f"{what}: masks are read from the folder masks")
    return lines


def _without_camera(capture: Capture, files: Files) -> list[Path]:
    """List the photos without a camera, except pictures that belong to one with a camera."""
    # RAW files, normals and depth belong to a photo: they are in its folder, and their names begin with the photo's.
    used = {view.image_path for view in capture.views}
    stems = {(photo.parent, fold(without_suffix(photo.name))) for photo in used}
    folders = {photo.parent for photo in used}
    above = {above for photo in used for above in photo.parents}
    tops = {top for name in PHOTO_FOLDERS if (top := files.find_folder(name)) is not None and top in above}
    found = {photo for folder in folders | tops for photo in photos_in(files, folder, deep=folder in tops)}

    def beside_one(photo: Path) -> bool:
        name = fold(without_suffix(photo.name))
        starts = [name, *(name[: word.start()] for word in re.finditer(r"[-_. ](?=.*[^\W\d_])", name))]
        return any((photo.parent, start) in stems for start in starts)

    return sorted(photo for photo in found - used if not beside_one(photo))


def _count(files: list[Path], what: str) -> str:
    return f"{len(files)} {what}{'s' if len(files) > 1 else ''}"


def _name(files: Files, path: Path) -> str:
    return path.relative_to(files.folder).as_posix() if path.is_relative_to(files.folder) else str(path)
