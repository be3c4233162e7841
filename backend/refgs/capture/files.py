"""Find the photos of a capture on disk by the names in its camera files, and combine each photo with its camera in a View."""

import os
import posixpath
import re
import unicodedata
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, TypeVar

from refgs.camera import Camera
from refgs.capture.images import FORMATS, read_header
from refgs.capture.lens import Lens
from refgs.capture.raw import SUFFIXES as RAW_SUFFIXES
from refgs.capture.types import Split, View
from refgs.errors import InputError, one_line

T = TypeVar("T")

PICTURE_SUFFIXES = tuple(suffix for suffixes in FORMATS.values() for suffix in suffixes)
IMAGE_SUFFIXES = (*PICTURE_SUFFIXES, ".exr", *RAW_SUFFIXES)  # where several files fit, the first is preferred
PHOTO_FOLDERS = ("images", "input")
MASK_FOLDERS = ("masks", "mask", "alpha", "images_mask", "images_masks")  # the first is ours, then other programs'
_RANKS = {suffix: rank for rank, suffix in enumerate(IMAGE_SUFFIXES)}
# Words by which other programs tell a mask from its photo, as in 0001_mask.png, mask_0001.png and 0001.jpg.mask.png.
_MASK_WORDS = re.compile(r"(?:mask|alpha|matte)[-_. ](?P<after>.+)|(?P<before>.+)[-_. ](?:mask|alpha|matte)", re.I)


def is_image(name: str) -> bool:
    """Tell by its name whether a file is an image and not hidden."""
    return not name.startswith(".") and os.path.splitext(name)[1].lower() in _RANKS


def fold(name: str) -> str:
    """Return a name for comparison: without letter case, in Unicode's form NFC."""
    return unicodedata.normalize("NFC", name).casefold()


def without_suffix(name: str) -> str:
    """Return a file name or path without its image suffix; other endings stay."""
    stem, suffix = os.path.splitext(name)
    return stem if suffix.lower() in _RANKS else name


def without_mask_word(name: str) -> str:
    """Remove the word for mask from a name without suffix: `0001_mask` becomes `0001`."""
    found = _MASK_WORDS.fullmatch(name)
    return name if found is None else found["after"] or found["before"]


class _Listing(NamedTuple):
    """Hold a folder's names by folded name; keys of `stems` have no image suffix."""

    files: dict[str, list[str]]
    stems: dict[str, list[str]]
    folders: dict[str, list[str]]


class Files:
    """Find a capture's files by the names that the capture gives them. Each folder is listed only once.

    A name may differ from the file's in letter case or in Unicode's form. It may have `\\` in place of `/`, and another image suffix or
    none. It may also be an absolute path on another machine. All names of the same file lead to the same path. `folder` is the capture's
    folder.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self._listings: dict[Path, _Listing] = {}
        self._folders: dict[tuple[str, ...], Path | None] = {(): folder}
        self._owned: dict[Path, Path] = {}

    def find(self, name: str, *homes: str, suffixes: bool = True) -> Path | None:
        """Return the file called `name`, a path relative to the capture's folder or an absolute path. Return None if it is missing.

        A relative path is looked for in the capture's folder, then in its subfolders `homes`, such as "images". An absolute path that does
        not exist is shortened: its first folders are dropped one by one, and what remains is looked for in the capture's folder. At last
        the bare file name is looked for in `homes`. If `suffixes` is false, a file with another suffix than that of `name` is not returned.
        """
        for folder, last in self._places(name, homes):
            if (file := self._pick(folder, last, suffixes)) is not None:
                return file
        return None

    def find_folder(self, *parts: str) -> Path | None:
        """Return the folder at `parts` below the capture's folder, ignoring case, or None."""
        if parts not in self._folders:
            above = self.find_folder(*parts[:-1])
            self._folders[parts] = None if above is None else self.folder_in(above, parts[-1])
        return self._folders[parts]

    def folder_in(self, above: Path, name: str) -> Path | None:
        """Return the folder `name`, in any letter case, in `above`, or None."""
        names = self._list(above).folders.get(fold(name), [])
        return above / (name if name in names else min(names)) if names else None

    def images(self, folder: Path) -> list[str]:
        """List the names of the images in a folder, sorted. Hidden files are left out."""
        return sorted(name for names in self._list(folder).files.values() for name in names if is_image(name))

    def all_images(self, folder: Path) -> Iterator[Path]:
        """Yield a folder's images, then its subfolders', each sorted, without hidden ones."""
        yield from (folder / name for name in self.images(folder))
        for inner in self.folders(folder):
            yield from self.all_images(inner)

    def folders(self, folder: Path) -> list[Path]:
        """List the folders in a folder, sorted, without hidden ones and __MACOSX."""
        names = sorted(name for names in self._list(folder).folders.values() for name in names)
        inner = [folder / name for name in names if not name.startswith((".", "__MACOSX"))]
        real = os.path.join(os.path.realpath(folder), "")
        return [path for path in inner if not real.startswith(os.path.join(os.path.realpath(path), ""))]  # no circles

    def masks_beside(self, folder: Path) -> dict[str, str]:
        """Map the names of masks beside photos to the photos' folded names without suffix."""
        stems, masks = self._list(folder).stems, {}
        for name in (name for names in stems.values() for name in names if is_image(name)):
            of = without_mask_word(without_suffix(name))
            if of != without_suffix(name) and (of := fold(without_suffix(of))) in stems:
                masks[name] = of
        return masks

    def _places(self, name: str, homes: tuple[str, ...]) -> Iterator[tuple[Path, str]]:
        """Yield each existing folder that may hold a file, with the file's name there."""
        text = name.replace("\\", "/")
        absolute = text.startswith("/") or re.match(r"[A-Za-z]:", text) is not None
        path = posixpath.normpath(text)
        tails = [[part for part in path.split("/") if part not in (".", "..", "") and not part.endswith(":")]]
        inside = not absolute and not path.startswith("..")
        if not inside:
            outside = Path(text) if os.path.isabs(text) else self.folder / path
            if (not absolute or os.path.isabs(text)) and outside.name:
                folder = self._own(outside.parent)
                if os.path.isdir(folder):
                    yield folder, outside.name
            tails = [tails[0][start:] for start in range(1, len(tails[0]))] or tails
        last = tails[0] if inside else tails[-1]
        for parts in [*tails, *([home, *last] for home in homes)]:
            if parts and (folder := self.find_folder(*parts[:-1])) is not None:
                yield folder, parts[-1]

    def _own(self, folder: Path) -> Path:
        """Resolve a folder's links if it then lies in `self.folder`, else return it unchanged."""
        if folder not in self._owned:
            real, top = os.path.realpath(folder), os.path.realpath(self.folder)
            inside = real == top or real.startswith(os.path.join(top, ""))
            self._owned[folder] = self.folder / os.path.relpath(real, top) if inside else folder
        return self._owned[folder]

    def _pick(self, folder: Path, name: str, suffixes: bool) -> Path | None:
        files, stems, _ = self._list(folder)
        names = files.get(fold(name), [])
        if suffixes and not names:
            names = stems.get(fold(name)) or stems.get(fold(without_suffix(name)), [])
        if not names:
            return None
        return folder / (name if name in names else min(names, key=_preference))

    def _list(self, folder: Path) -> _Listing:
        if folder not in self._listings:
            self._listings[folder] = listing = _Listing({}, {}, {})
            with suppress(OSError), os.scandir(folder) as entries:  # it may be unreadable
                for entry in entries:
                    with suppress(OSError):  # links in a circle
                        _sort(entry, listing)
        return self._listings[folder]


def _sort(entry: os.DirEntry, listing: _Listing) -> None:
    """Add a folder's entry to its listing, unless it is a pipe or a device."""
    name = entry.name
    if entry.is_dir():
        listing.folders.setdefault(fold(name), []).append(name)
    elif entry.is_file():
        listing.files.setdefault(fold(name), []).append(name)
        if is_image(name):
            listing.stems.setdefault(fold(without_suffix(name)), []).append(name)


def _preference(name: str) -> tuple[int, str]:
    return _RANKS.get(os.path.splitext(name)[1].lower(), len(_RANKS)), name


def photo_folder(files: Files) -> Path:
    """Return the subfolder `images` or `input` that has images, else the capture's folder."""
    for name in PHOTO_FOLDERS:
        folder = files.find_folder(name)
        if folder is not None and next(files.all_images(folder), None) is not None:
            return folder
    return files.folder


def find_photos(folder: Path) -> list[Path]:
    """List the photos in the subfolder `images` or `input`, and in its subfolders.

    If neither subfolder has images, list the photos in the folder itself. Photos are sorted by name in each folder. A mask beside its
    photo, such as NAME_alpha.png, is not listed. RAW or EXR is not listed if another image in the same folder has the same name: many
    cameras write a photo as RAW and as JPEG.
    """
    files = Files(folder)
    top = photo_folder(files)
    return photos_in(files, top, deep=top != folder)


def photos_in(files: Files, folder: Path, deep: bool) -> list[Path]:
    """List a folder's photos, with `deep` also those in subfolders except folders of masks."""
    names, masks = files.images(folder), files.masks_beside(folder)
    pictures = {without_suffix(name) for name in names if name.lower().endswith(PICTURE_SUFFIXES)}
    found = [
        folder / name
        for name in names
        if name not in masks and (name.lower().endswith(PICTURE_SUFFIXES) or without_suffix(name) not in pictures)
    ]
    inner = [path for path in files.folders(folder) if deep and fold(path.name) not in MASK_FOLDERS]
    return found + [photo for path in inner for photo in photos_in(files, path, deep)]


def leave_out_missing(source: Path, found: list[tuple[T, str, Path | None]]) -> tuple[list[tuple[T, Path]], list[str]]:
    """Leave out photos whose files are missing: the user may have removed blurred ones. Raises InputError if more than half are missing.

    `found` has a tuple for each photo: any object that belongs to it, its name, and its file or None. Returns the pairs (object, file) of
    the photos that have a file, and a list with one warning if any photo is missing, otherwise an empty list. `source` is the file or
    folder that names the photos. If more than half are missing, `source` probably belongs to another capture, or was moved.
    """
    missing = [name for _, name, file in found if file is None]
    if 2 * len(missing) > len(found):
        raise InputError(
            f"{source}: {len(missing)} of the {len(found)} images it names are missing, the first is {missing[0]}. "
            "Put them back, or remove them from the file."
        )
    left = [(other, file) for other, _, file in found if file is not None]
    if not missing:
        return left, []
    what = f"{len(missing)} of the {len(found)} images in {source.name} are missing and left out, first {missing[0]}"
    return left, [one_line(what)]


def photo_view(
    image: Path,
    as_given: tuple[Camera, Lens | None],
    split: Split,
    mask: Path | None,
    where: str,
    mask_below: float | None = None,
) -> View:
    """Combine a photo, its camera and its mask in a View.

    `as_given` is the camera and lens from the capture's file. Camera and lens are scaled if they are for another resolution than the
    photo's. If the photo has an EXIF orientation, camera and lens are turned upright like the photo, because COLMAP and nerfstudio make
    cameras for photos as stored. Camera and lens are not turned if the camera's size fits the upright photo, but not the stored one.
    `mask_below` is set only for a mask that is a depth map (see `View`).

    Raises InputError if the photo's aspect ratio differs from the camera's, or the mask's size from the photo's. `where` is a name for the
    camera in error messages.
    """
    header = read_header(image)
    width, height, has_alpha, turns = header
    camera, lens = as_given
    if turns % 2 and (camera.width - camera.height) * (height - width) > 0:
        width, height, turns = height, width, 0
    if (camera.width, camera.height) != (width, height):
        sx, sy = width / camera.width, height / camera.height
        if abs(sx / sy - 1) > 0.01:
            raise InputError(
                f"{where}: the camera is for {camera.width}×{camera.height} pixels but the photo has {width}×{height}. "
                "Use the photos that the poses were made from (not rotated or cropped)."
            )
        camera = camera.resized(width, height)
        if lens is not None:
            lens = replace(lens, fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy)
    for _ in range(turns):
        lens = lens and lens.turned(camera.height)
        camera = camera.turned()
    if lens is not None:
        camera = lens.pinhole(camera, where)
    if mask is not None:
        mask_size = read_header(mask).upright
        if mask_size not in (header.upright, header[:2]):
            raise InputError(
                f"{mask}: the mask has {mask_size[0]}×{mask_size[1]} pixels but its photo {image.name} "
                f"{camera.width}×{camera.height}. Make the mask the photo's size."
            )
    return View(camera, image, mask, split, lens, has_alpha and mask is None, mask_below)
