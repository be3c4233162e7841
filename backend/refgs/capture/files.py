"""Find the photos and masks of a capture on disk, and combine each photo with its camera in a View."""

import os
from dataclasses import replace
from pathlib import Path

from refgs.camera import Camera
from refgs.capture.images import read_header
from refgs.capture.lens import Lens
from refgs.capture.raw import SUFFIXES as RAW_SUFFIXES
from refgs.capture.types import Split, View
from refgs.errors import InputError

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".heic", ".heif", ".hif", ".tif", ".tiff", ".webp", ".bmp")
IMAGE_SUFFIXES = (*PICTURE_SUFFIXES, ".exr", *RAW_SUFFIXES)


def find_image(path: Path, any_suffix: bool = False) -> Path | None:
    """Return the image file at `path`. If it is absent, try `path` with an image suffix added. Return None if no file is found.

    With `any_suffix`, an image suffix of `path` may also be replaced by another one.
    """
    # Not Path.is_file, which raises OSError for a name that is too long.
    if os.path.isfile(path):
        return path
    if not path.name:  # the root
        return None
    if any_suffix and path.suffix.lower() in IMAGE_SUFFIXES:
        path = path.with_suffix("")
    names = (path.with_name(path.name + suffix) for suffix in IMAGE_SUFFIXES + tuple(map(str.upper, IMAGE_SUFFIXES)))
    return next((name for name in names if os.path.isfile(name)), None)


def find_photos(folder: Path) -> list[Path]:
    """List the photos in the subfolder `images`, or in the folder itself if it has no such subfolder. They are sorted by name.

    A file NAME_alpha.png beside a photo NAME is its mask and is not listed. RAW or EXR is not listed if another image has the same name:
    many cameras write a photo as RAW and as JPEG.
    """
    top = folder / "images" if (folder / "images").is_dir() else folder
    found = {path.name: path for path in sorted(top.iterdir()) if path.suffix.lower() in IMAGE_SUFFIXES}
    masks = {f"{path.stem}_alpha.png" for path in found.values()}
    pictures = {path.stem for path in found.values() if path.suffix.lower() in PICTURE_SUFFIXES}
    return [
        path
        for name, path in found.items()
        if name not in masks and (path.suffix.lower() in PICTURE_SUFFIXES or path.stem not in pictures)
    ]


def all_found(source: Path, found: list[tuple[str, Path | None]]) -> list[Path]:
    """Return the files of photos. Raises InputError if any are missing.

    `found` has each photo's name and its file, which is None if the photo is missing. `source` is the file or folder that names the photos;
    the error message begins with it.
    """
    missing = [name for name, file in found if file is None]
    if missing:
        raise InputError(
            f"{source}: {len(missing)} of the {len(found)} images it names are missing, the first is {missing[0]}. "
            "Put them back, or remove them from the file."
        )
    return [file for _, file in found if file is not None]


class Masks:
    """Find the mask file of each photo of a capture.

    The mask of NAME.jpg is NAME.png or NAME.jpg.png in the folder `masks`. Other image suffixes than .png are allowed. If photos are in
    subfolders, their masks are in subfolders of `masks` with the same names. If the folder `masks` has no mask of a photo, NAME_alpha.png
    beside the photo is used, as in the scene `ball` of Shiny Blender.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        root = folder / "masks"
        self.files = {
            path.relative_to(root).as_posix().removesuffix(path.suffix): path
            for path in (sorted(root.rglob("*")) if root.is_dir() else [])
            if path.suffix.lower() in IMAGE_SUFFIXES
        }

    def find(self, image: Path, named: str | None, where: str) -> Path | None:
        """Return the mask file of the photo `image`, None if it has none.

        `named` is the mask's path, relative to the capture's folder, if the capture's JSON file gives one. If `named` is empty, the mask is
        found by the photo's name. Raises InputError if the mask `named` is missing. `where` is a name for the camera in the error message.
        """
        if named:
            path = find_image(self.folder / named.replace("\\", "/"))
            if path is None:
                raise InputError(f"{where}: the mask {named} is missing. Put it back, or remove its mask_path.")
            return path
        parts = image.relative_to(self.folder).parts if image.is_relative_to(self.folder) else ()
        for name in ("/".join(parts), "/".join(parts[1:])):
            mask = self.files.get(name) or self.files.get(name.removesuffix(image.suffix))
            if mask is not None:
                return mask
        beside = image.with_name(f"{image.stem}_alpha.png")
        return beside if os.path.isfile(beside) else None


def photo_view(
    image: Path,
    as_given: tuple[Camera, Lens | None],
    split: Split,
    mask: Path | None,
    where: str,
    mask_below: float | None = None,
) -> View:
    """Combine a photo, its camera and its mask in a View.

    `as_given` is the camera and lens from the capture's file. If they are for another resolution than the photo's, they are scaled. If the
    photo has an EXIF orientation, they are turned upright with the photo, because COLMAP and nerfstudio make cameras for photos as stored.
    They are not turned if the camera's size already fits the upright photo and not the stored one. `mask_below` is set only for a mask that
    is a depth map (see `View`).

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
