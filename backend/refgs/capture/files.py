"""Find the photos and masks of a capture on disk, and make a view of each photo."""

from dataclasses import replace
from pathlib import Path

from refgs.camera import Camera
from refgs.capture.images import read_header
from refgs.capture.lens import Lens
from refgs.capture.types import Split, View
from refgs.errors import InputError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")


def find_image(path: Path, any_suffix: bool = False) -> Path | None:
    """Return the file at `path`, or else at `path` with an image suffix added. Return None if both are absent.

    With `any_suffix` also try other image suffixes in place of the suffix of `path`.
    """
    if path.is_file():
        return path
    if any_suffix and path.suffix.lower() in IMAGE_SUFFIXES:
        path = path.with_suffix("")
    names = (path.with_name(path.name + suffix) for suffix in IMAGE_SUFFIXES + tuple(map(str.upper, IMAGE_SUFFIXES)))
    return next((name for name in names if name.is_file()), None)


def find_photos(folder: Path) -> list[Path]:
    """Return the photos in the subfolder `images`, or else in the folder itself, sorted by name. NAME_alpha.png is a mask, not a photo."""
    top = folder / "images" if (folder / "images").is_dir() else folder
    found = {path.name: path for path in sorted(top.iterdir()) if path.suffix.lower() in IMAGE_SUFFIXES}
    masks = {f"{path.stem}_alpha.png" for path in found.values()}
    return [path for name, path in found.items() if name not in masks]


def report_missing(source: Path, missing: list[str], total: int) -> None:
    """Raise InputError if photos that the file `source` names are missing."""
    if missing:
        raise InputError(
            f"{source}: {len(missing)} of the {total} images it names are missing, the first is {missing[0]}. "
            "Put them back, or remove them from the file."
        )


class Masks:
    """Masks of a capture: for NAME.jpg, the file NAME.png or NAME.jpg.png in the folder `masks`, with any image suffix.

    If photos are in subfolders, `masks` has the same subfolders. If that mask is missing, NAME_alpha.png beside the photo is used, as in
    the scene `ball` of Shiny Blender.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        root = folder / "masks"
        self.files = {
            path.relative_to(root).as_posix().removesuffix(path.suffix): path
            for path in (sorted(root.rglob("*")) if root.is_dir() else [])
            if path.suffix.lower() in IMAGE_SUFFIXES
        }

    def find(self, image: Path, named: object, where: str) -> Path | None:
        """Return the mask of a photo: the file `named`, relative to the folder, or else a mask with the photo's name. None if absent.

        Raises InputError, which begins with `where`, if the file `named` is missing.
        """
        if named:
            path = find_image(self.folder / str(named).replace("\\", "/"))
            if path is None:
                raise InputError(f"{where}: the mask {named} is missing. Put it back, or remove its mask_path.")
            return path
        parts = image.relative_to(self.folder).parts if image.is_relative_to(self.folder) else ()
        for name in ("/".join(parts), "/".join(parts[1:])):
            mask = self.files.get(name) or self.files.get(name.removesuffix(image.suffix))
            if mask is not None:
                return mask
        beside = image.with_name(f"{image.stem}_alpha.png")
        return beside if beside.is_file() else None


def photo_view(
    image: Path,
    as_given: tuple[Camera, Lens | None],
    split: Split,
    mask: Path | None,
    where: str,
    mask_below: float | None = None,
) -> View:
    """Make the view of a photo. `as_given` is the camera and lens from the capture's file. Error messages name the camera by `where`.

    `mask_below` has the meaning of `View.mask_below`. Intrinsics are scaled if they were given for another resolution than the photo's.
    Raises InputError if the camera's aspect ratio or the mask's size differs from the photo's.
    """
    width, height, has_alpha = read_header(image)
    camera, lens = as_given
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
    if lens is not None:
        camera = lens.pinhole(camera, where)
    if mask is not None:
        mask_size = read_header(mask)[:2]
        if mask_size != (width, height):
            raise InputError(
                f"{mask}: the mask has {mask_size[0]}×{mask_size[1]} pixels but its photo {image.name} "
                f"{width}×{height}. Make the mask the photo's size."
            )
    return View(camera, image, mask, split, lens, has_alpha and mask is None, mask_below)
