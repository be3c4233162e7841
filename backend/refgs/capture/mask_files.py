"""Find the mask files of a capture's photos by their names."""

import os
import re
from collections import Counter
from itertools import product
from pathlib import Path

from refgs.capture.files import MASK_FOLDERS, Files, fold, without_mask_word, without_suffix


def find_masks(files: Files, photos: list[Path]) -> dict[Path, Path]:
    """Return the mask file of each photo that has one.

    The mask of NAME.jpg is in the folder `masks`, or in another of MASK_FOLDERS. It is called NAME.png, NAME.jpg.png, NAME_mask.png,
    mask_NAME.png or NAME.jpg.mask.png. It may have another image suffix than .png.

    If photos are in subfolders, their masks are in one of these places:

    - in subfolders of `masks` with the same names
    - in `masks` itself, if no two photos have the same name
    - in a folder `masks` beside the photos, or beside the folder of the photos

    If a photo has no such mask, a mask beside the photo is used, such as NAME_alpha.png or NAME_mask.png. The scene `ball` of Shiny Blender
    has such masks.
    """
    found: dict[Path, Path] = {}
    beside, together = {}, {}
    for photo in photos:
        together.setdefault(photo.parent, []).append(photo)
    for folder, some in together.items():
        for root, name in product((folder, folder.parent), MASK_FOLDERS):
            if root != files.folder and (inner := files.folder_in(root, name)) is not None:
                found |= _match(files, inner, root, [photo for photo in some if photo not in found])
        beside |= {(folder, of): folder / name for name, of in sorted(files.masks_beside(folder).items(), reverse=True)}
    for folder in mask_folders(files, photos):
        found |= _match(files, folder, files.folder, [photo for photo in photos if photo not in found])
    named = set(photos)
    for photo in photos:
        mask = beside.get((photo.parent, fold(without_suffix(photo.name))))
        if photo not in found and mask is not None and mask not in named:
            found[photo] = mask
    return found


def mask_folders(files: Files, photos: list[Path]) -> list[Path]:
    """List the folders that may hold masks, such as `masks_4` first for `images_4`."""
    reduced = [match[0] for photo in photos[:1] if (match := re.search(r"_\d+$", photo.parent.name))]
    names = [f"{name}{end}" for end in (*reduced, "") for name in MASK_FOLDERS]
    return [folder for name in names if (folder := files.find_folder(name)) is not None]


def _match(files: Files, folder: Path, root: Path, photos: list[Path]) -> dict[Path, Path]:
    """Map photos of `root` to their masks in `folder`, those with the most similar names."""
    # Masks by their names: without suffix; without the word "mask", too; without the photo's suffix, too.
    exact, worded, bare = {}, {}, {}
    for mask in files.all_images(folder):
        inner = mask.relative_to(folder).as_posix()
        exact[fold(os.path.splitext(inner)[0])] = mask
        above, _, name = inner.rpartition("/")
        name = without_mask_word(without_suffix(name))
        worded[fold(f"{above}/{name}".lstrip("/"))] = mask
        bare[fold(f"{above}/{without_suffix(name)}".lstrip("/"))] = mask
    found = {}
    inner = {photo: _inner(root, photo) for photo in photos}
    for names in (exact, worded):
        for photo, paths in inner.items():
            keys = [key for path in paths for key in (fold(path), fold(without_suffix(path)))]
            if photo not in found and (mask := next((names[key] for key in keys if key in names), None)):
                found[photo] = mask
    used, alone = set(found.values()), Counter(fold(without_suffix(photo.name)) for photo in photos)
    for photo, paths in inner.items():
        keys = [fold(without_suffix(path)) for path in paths]
        if alone[fold(without_suffix(photo.name))] == 1:
            keys.append(fold(without_suffix(photo.name)))
        if photo not in found and (mask := next((bare[key] for key in keys if key in bare), None)) not in used | {None}:
            found[photo] = mask
    return found


def _inner(root: Path, photo: Path) -> list[str]:
    """Return a photo's path relative to `root`, with and without its first folder."""
    parts = photo.relative_to(root).parts if photo.is_relative_to(root) else photo.parts[-1:]
    return ["/".join(some) for some in (parts, parts[1:]) if some]
