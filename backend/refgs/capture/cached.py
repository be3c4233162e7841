"""Load a capture's photos for training. To save memory, photos of a large capture are cached as NumPy files and memory-mapped.

A photo's cache files are named by a hash of all that its pixels depend on. A resumed training reuses the files whose hash is unchanged, and
writes new ones for the other photos.
"""

import hashlib
import mmap
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import repeat
from pathlib import Path

import numpy as np

from refgs import CORES, __version__
from refgs.camera import Camera
from refgs.capture.images import LoadedView, load_view
from refgs.capture.reduce import reduced
from refgs.capture.types import View
from refgs.paths import check_file, whole

LARGE = 500e6  # bytes of all photos of a capture, from which on they are cached


def load_views(views: list[View], max_side: int, folder: Path) -> list[LoadedView]:
    """Load photos for training as `load_view` does. If they take much memory (more than LARGE bytes), cache them in `folder`.

    The arrays of a cached photo are memory-mapped. Changes to an array are not written to its file. `release_memory` undoes them. If the
    disk is full, photos are held in memory. Raises InputError naming the photo that cannot be read.
    """
    cameras = [view.camera.fitted(max_side) for view in views]
    if sum(4 * camera.width * camera.height for camera in cameras) <= LARGE:
        with ThreadPoolExecutor(CORES) as threads:  # decoders and NumPy work outside of Python's lock
            return list(threads.map(load_view, views, repeat(max_side)))
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    names = [_name(view, max_side) for view in views]
    loaded = [
        _read(camera, folder, name) or _cached(load_view(view, max_side), folder, name)
        for view, camera, name in zip(views, cameras, names, strict=True)
    ]
    for file in folder.glob("*"):
        if file.name.split(".")[0] not in names:
            with suppress(OSError):  # Windows removes no mapped file
                file.unlink()
    return loaded


def reduced_views(views: list[LoadedView], factor: int, folder: Path) -> list[LoadedView]:
    """Reduce the sides of loaded photos by a factor, in linear light as `load_view` does. If `folder` exists, cache the results in it.

    If the photos are memory-mapped, only one at a time takes memory.
    """
    found = []
    for number, view in enumerate(views):
        width, height = (max(1, round(side / factor)) for side in (view.camera.width, view.camera.height))
        camera = view.camera.resized(width, height)
        small = LoadedView(*reduced(view.image, view.alpha, view.white, view.camera, camera), camera, view.white)
        found.append(_cached(small, folder, f"{number:05}-{factor}") if folder.is_dir() else small)
        release_memory([view])
    return found


def release_memory(views: list[LoadedView]) -> None:
    """Free the memory of memory-mapped photos on Linux; changed pixels are lost."""
    if not hasattr(mmap, "MADV_DONTNEED") or sys.platform != "linux":
        return
    for view in views:
        for array in (view.image, view.alpha):
            if array is not None and isinstance(array.base, np.memmap) and isinstance(array.base.base, mmap.mmap):
                array.base.base.madvise(mmap.MADV_DONTNEED)


def remove_cached(folder: Path) -> None:
    """Remove the files of cached photos. On Windows, files that are still mapped stay."""
    shutil.rmtree(folder, ignore_errors=True)


def _name(view: View, max_side: int) -> str:
    """Return the name of a photo's files, a hash of what its pixels depend on."""
    camera, files = view.camera, []
    for path in (view.image_path, view.mask_path):
        if path is not None and path.exists():
            files.append((str(path.resolve()), path.stat().st_size, path.stat().st_mtime_ns))
    numbers = [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]
    what = (__version__, max_side, files, numbers, view.lens, view.has_alpha, view.mask_below)
    return hashlib.sha256(repr(what).encode()).hexdigest()[:24]


def _read(camera: Camera, folder: Path, name: str) -> LoadedView | None:
    """Memory-map a photo's cache files. Return None if they are missing or damaged."""
    image = next(folder.glob(f"{name}.image.*.npy"), None)
    if image is None:
        return None
    alpha, size = folder / f"{name}.alpha.npy", (camera.height, camera.width)
    try:
        pixels = _mapped(image, (*size, 3), np.uint8, np.uint16)
        mask = _mapped(alpha, size, np.uint8) if alpha.exists() else None
        return LoadedView(pixels, mask, camera, int(image.name.split(".")[2]))
    except Exception:  # NumPy evaluates a file's header, and raises errors of many types
        return None


def _mapped(file: Path, shape: tuple[int, ...], *kinds: type) -> np.ndarray:
    """Memory-map an array of `shape` and a dtype in `kinds`, or raise any exception."""
    check_file(file)
    values = np.asarray(np.load(file, mmap_mode="c"))  # not "r", as torch warns of arrays that it must not write
    if values.shape != shape or values.dtype not in kinds:
        raise ValueError("another array")
    return values


def _cached(view: LoadedView, folder: Path, name: str) -> LoadedView:
    """Return the photo memory-mapped from new cache files, or unchanged if writing fails."""
    try:
        _write(view, folder, name)
    except OSError:
        return view
    return _read(view.camera, folder, name) or view


def _write(view: LoadedView, folder: Path, name: str) -> None:
    """Write a photo's cache files, the image last. Raises OSError if the disk is full."""
    if shutil.disk_usage(folder).free < 2 * view.image.nbytes:
        raise OSError
    files = [(f"{name}.image.{view.white}.npy", view.image)]
    if view.alpha is not None:
        files = [(f"{name}.alpha.npy", view.alpha), *files]
    for file, values in files:
        with whole(folder / file) as temporary, open(temporary, "wb") as handle:
            np.save(handle, values)
