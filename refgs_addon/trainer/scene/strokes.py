"""Paint strokes on photos: white on the object, black on everything else. The trainer corrects the masks by them.

A canvas is an image in Blender. It shows the photo in the middle of the brightness range, so that only strokes are white or black. Pixels
outside the mask are red. The strokes alone are written to CAPTURE/strokes (docs/photos.md), transparent where nothing was painted.
"""

import re
import struct
from pathlib import Path
from typing import TYPE_CHECKING

import bpy

from ...errors import InputError
from ...ordinary import check_file, open_file
from ...scene.atomic_file import atomic_write
from ...scene.camera_objects import MASK, PHOTO, STROKES

if TYPE_CHECKING:
    import numpy as np

CAPTURE = "refgs_capture"  # custom property of a canvas: the capture's folder
LONGEST = 1600  # pixels of a canvas on its longer side
DARKEST, BRIGHTEST = 0.2, 0.8  # of the photo on a canvas
BLACK, WHITE = 0.1, 0.9  # limits of what counts as a stroke
OUTSIDE = 0.75, 0.2, 0.25  # colour over what the mask leaves out
TURNS = {3: 2, 6: 3, 8: 1}  # quarter turns, counter-clockwise, that an EXIF orientation asks for


def camera_with_photo(context: bpy.types.Context) -> bpy.types.Object | None:
    """Find the camera with a photo: the active object, else the scene's camera, or None."""
    for item in (context.view_layer.objects.active, context.scene.camera):
        if item is not None and item.type == "CAMERA" and item.data.get(PHOTO):
            return item
    return None


def canvases() -> list[bpy.types.Image]:
    """List the open file's canvases, images on which the artist paints strokes over photos."""
    return [image for image in bpy.data.images if STROKES in image]


def add_canvas(capture: Path, camera: bpy.types.Object) -> bpy.types.Image:
    """Make a canvas of a camera's photo: an image on which the artist paints strokes. If the photo has a canvas already, return that one.

    The canvas shows the strokes and the mask that the photo has already. Raises InputError if the photo is not in the folder `capture`, or
    if Blender cannot open it.
    """
    photo = Path(camera.data[PHOTO])
    capture = masks_root(capture)
    file = capture / "strokes" / _name_in(capture, photo)
    for canvas in canvases():
        if canvas[STROKES] == str(file):
            return canvas
    width, height = camera.data["refgs_size"]
    scale = min(1.0, LONGEST / max(width, height))
    width, height = max(1, round(width * scale)), max(1, round(height * scale))
    picture = _read_photo(photo, width, height)
    canvas = bpy.data.images.new(f"Strokes on {photo.name}", width, height, alpha=True)
    canvas[CAPTURE], canvas[STROKES] = str(capture), str(file)
    canvas[PHOTO], canvas[MASK] = str(photo), camera.data.get(MASK, "")
    _draw(canvas, picture, _read(file, width, height) if file.is_file() else None)
    return canvas


def show_masks(capture: Path, masks: dict[str, str]) -> None:
    """Show new masks on the canvases of a capture. All strokes stay, even unsaved ones.

    `masks` maps the paths of photos in the folder `capture` to those of their masks. Cameras keep them for canvases that are made later.
    """
    files = {(capture / photo).resolve(): str(capture / mask) for photo, mask in masks.items()}
    for item in (*bpy.data.cameras, *canvases()):
        if item.get(PHOTO) and (mask := files.get(Path(item[PHOTO]).resolve())):
            item[MASK] = mask
    for canvas in canvases():
        if canvas[CAPTURE] == str(masks_root(capture)):
            _draw(canvas, _read_photo(Path(canvas[PHOTO]), *canvas.size), _strokes(canvas))


def save(capture: Path) -> list[Path]:
    """Write the strokes on a capture's canvases to files. Raises InputError where nothing was painted."""
    files = []
    for canvas in canvases():
        strokes, file = _strokes(canvas), Path(canvas[STROKES])
        if canvas[CAPTURE] == str(masks_root(capture)) and (file.exists() or strokes[..., 3].any()):
            file.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(file) as temporary:
                _write(strokes, temporary)
            canvas.pack()  # otherwise Blender asks to save it when it quits
            files.append(file)
    if not files:
        raise InputError("nothing was painted: paint white on the object, or black on what is not the object")
    return files


def masks_root(capture: Path) -> Path:
    """Return the folder in which a capture's folders `masks` and `strokes` are.

    This is `capture` itself, or the folder above it if `capture` is a folder of reduced photos, such as images_4.
    """
    reduced = re.fullmatch(r"images_\d+", capture.name) and (capture.parent / "sparse").is_dir()
    return capture.parent if reduced else capture


def _name_in(capture: Path, photo: Path) -> Path:
    """Return the relative path of a photo's strokes. Raises InputError unless `capture` has the photo."""
    try:
        inner = photo.resolve().relative_to(capture.resolve())
    except ValueError:
        raise InputError(f"{photo.name} is not a photo of {capture}: select a camera of that capture") from None
    inner = Path(*inner.parts[1:]) if len(inner.parts) > 1 else inner
    # Photos that differ only in their suffix keep it.
    alone = not any(
        other != photo and other.suffix.lower() in _SUFFIXES for other in photo.parent.glob(f"{photo.stem}.*")
    )
    return inner.with_suffix(".png") if alone else inner.with_name(f"{inner.name}.png")


_SUFFIXES = {".jpg", ".jpeg", ".png", ".heic", ".tif", ".tiff", ".webp", ".bmp"}


def _draw(canvas: bpy.types.Image, picture: "np.ndarray", strokes: "np.ndarray | None") -> None:
    """Fill a canvas with the photo, red where its mask has no object, and the strokes."""
    import numpy as np

    width, height = canvas.size
    shown = np.ones((height, width, 4), np.float32)
    shown[..., :3] = DARKEST + (BRIGHTEST - DARKEST) * np.clip(picture[..., :3], 0, 1)
    mask = canvas.get(MASK)
    if mask and Path(mask).is_file():
        outside = _outside(_read(Path(mask), width, height))
        shown[outside, :3] = 0.4 * shown[outside, :3] + 0.6 * np.array(OUTSIDE, np.float32)
    if strokes is not None:
        drawn = strokes[..., 3] > 0.5
        shown[drawn, :3] = np.where(strokes[drawn, :3].mean(axis=1, keepdims=True) > 0.5, 1.0, 0.0)
    canvas.pixels.foreach_set(np.ascontiguousarray(shown[::-1]).ravel())
    canvas.update()
    canvas.pack()


def _outside(mask: "np.ndarray") -> "np.ndarray":
    """Tell where a mask (H, W, 4) has no object, bool (H, W): where its alpha, if it has some, or its brightness is low.

    Low is relative to the mask's own values: masks of other programs are 0 and 1 of 255, or colours of a palette.
    """
    values = mask[..., 3] if mask[..., 3].min() < 1 else mask[..., :3].max(axis=2)
    low, high = values.min(), values.max()
    return values <= ((low if low < high else 0) + high) / 2


def _strokes(canvas: bpy.types.Image) -> "np.ndarray":
    """Return a canvas's white or black strokes as RGBA (height, width, 4), top row first."""
    import numpy as np

    pixels = _pixels(canvas)
    strokes = np.zeros_like(pixels)
    painted = pixels[..., 3] > 0.5
    strokes[painted & (pixels[..., :3].min(axis=2) > WHITE)] = 1.0
    strokes[painted & (pixels[..., :3].max(axis=2) < BLACK), 3] = 1.0
    return strokes


def _pixels(image: bpy.types.Image) -> "np.ndarray":
    """Return an image's pixels as RGBA (height, width, 4) float32, top row first."""
    import numpy as np

    width, height = image.size
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(height, width, 4)[::-1]


def _read(path: Path, width: int, height: int, turns: int = 0) -> "np.ndarray":
    """Read a picture as RGBA, top row first, after `turns` counter-clockwise quarter turns. Raises InputError."""
    import numpy as np

    try:
        check_file(path)
        image = bpy.data.images.load(str(path), check_existing=False)
    except (OSError, RuntimeError):
        raise InputError(f"{path} does not exist: move the capture back to where it was") from None
    try:
        if not image.has_data and not image.size[0]:
            raise InputError(f"Blender cannot open {path}: paint on another photo, or save this one as JPEG")
        image.scale(*((height, width) if turns % 2 else (width, height)))
        pixels = np.rot90(_pixels(image), turns)
        # Pictures of more than 8 bits are linear in Blender.
        return np.clip(pixels, 0, 1) ** (1 / 2.2) if image.is_float else pixels
    finally:
        bpy.data.images.remove(image)


def _read_photo(path: Path, width: int, height: int) -> "np.ndarray":
    """Read a photo, turned upright and resized, as RGBA. The top row comes first."""
    return _read(path, width, height, TURNS.get(exif_orientation(path), 0))


def exif_orientation(path: Path) -> int:
    """Return the EXIF orientation of a JPEG file, 1 to 8, or 1 without one."""
    try:
        with open_file(path) as file:
            data = file.read(1 << 17)
        at = 2
        while data[:2] == b"\xff\xd8" and data[at] == 0xFF and data[at + 1] != 0xDA:
            size = struct.unpack_from(">H", data, at + 2)[0]
            if data[at + 1] == 0xE1 and data[at + 4 : at + 10] == b"Exif\0\0":
                return _orientation(data[at + 10 : at + 2 + size])
            at += 2 + size
    except (OSError, IndexError, struct.error):  # no photo, or broken: Blender says so when it opens it
        pass
    return 1


def _orientation(tiff: bytes) -> int:
    """Return the tag Orientation of a TIFF header, 1 if it has none."""
    order = "<" if tiff[:2] == b"II" else ">"
    start = struct.unpack_from(order + "I", tiff, 4)[0]
    for number in range(struct.unpack_from(order + "H", tiff, start)[0]):
        tag, _, _, value = struct.unpack_from(order + "HHIH", tiff, start + 2 + 12 * number)
        if tag == 0x0112:
            return value
    return 1


def _write(strokes: "np.ndarray", path: Path) -> None:
    """Write RGBA pixels, top row first, as a PNG file."""
    import numpy as np

    height, width = strokes.shape[:2]
    image = bpy.data.images.new("strokes", width, height, alpha=True)
    try:
        image.pixels.foreach_set(np.ascontiguousarray(strokes[::-1]).ravel())
        image.file_format, image.filepath_raw = "PNG", str(path)
        image.save()
    finally:
        bpy.data.images.remove(image)
