"""Measure how well cameras are found from photos alone: `refgs bench cameras --captures DIR`.

DIR has captures with cameras. Each is copied without them, `refgs poses` finds them anew, and they are compared with the given ones.
`--every 3 --side 400` makes the search harder: every third photo, reduced to 400 pixels. Learned features are a second try where they are
installed; `--features sift` does without, and `--features learned` tries nothing else. The time is the processors', summed over all cores,
because wall time depends on what else the machine does.
"""

import argparse
import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.harness import find_captures
from refgs.capture import motion, read_capture
from refgs.errors import InputError


def rotation_errors(found: np.ndarray, given: np.ndarray) -> np.ndarray:
    """Return by how many degrees each rotation (N, 3, 3) differs from the given one, once all are turned together.

    Both map from the world to the camera. The common turn is the one with the least sum of errors, so that a few cameras that are far
    off do not add to the others' errors.
    """
    weights = np.ones(len(found))
    for _ in range(20):
        u, _, vt = np.linalg.svd(np.einsum("n,nji,njk->ik", weights, given, found))
        common = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        apart = found @ common.T @ given.transpose(0, 2, 1)
        errors = np.degrees(np.arccos(np.clip((np.trace(apart, axis1=1, axis2=2) - 1) / 2, -1, 1)))
        weights = 1 / np.maximum(errors, 0.05)
    return errors


def rotations(capture: Path) -> dict[str, np.ndarray]:
    """Return the rotation (3, 3) from the world to the camera of each photo of a capture, by the photo's name."""
    return {view.image_path.name: view.camera.world_to_camera[:3, :3] for view in read_capture(capture).views}


def copy_photos(folder: Path, copy: Path, every: int, side: int | None) -> None:
    """Copy every `every`th photo of a capture with its mask to the folder `copy`, reduced to `side` pixels on the longer side."""
    for view in sorted(read_capture(folder).views, key=lambda view: view.image_path.name)[::every]:
        for file in filter(None, (view.image_path, view.mask_path)):
            out = copy / file.relative_to(folder)
            out.parent.mkdir(parents=True, exist_ok=True)
            if side is None:
                shutil.copy(file, out)
                continue
            with Image.open(file) as picture:
                exif = picture.getexif()
                picture.thumbnail((side, side), Image.Resampling.LANCZOS)
                picture.save(out, quality=95, exif=exif)


def main(arguments: Sequence[str] | None = None) -> None:
    """Find the cameras of all captures in a folder anew. Print how many were placed, their errors and the time, a row per capture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--captures", type=Path, required=True, help="folder with captures that have cameras")
    parser.add_argument("--every", type=int, default=1, help="use every Nth photo")
    parser.add_argument("--side", type=int, help="reduce photos to so many pixels on the longer side")
    parser.add_argument("--features", choices=("sift", "learned"), help="try only these features")
    options = parser.parse_args(arguments)
    if options.features:
        find = motion._find_inside_if_needed
        motion._find_inside_if_needed = lambda *given: find(*given[:4], options.features == "learned", given[5])
        motion.learned.installed = lambda: False  # no second try
    row = "{:<12} {:>6} {:>6} {:>7} {:>8} {:>9} {:>9} {:>10} {:>8} {:>6}".format
    head = (
        "capture",
        "photos",
        "placed",
        "mean °",
        "median °",
        "largest °",
        "within 1°",
        "masks only",
        "features",
        "CPU s",
    )
    print(row(*head))
    for folder in find_captures(options.captures):
        given = rotations(folder)
        with tempfile.TemporaryDirectory() as scratch:
            copy = Path(scratch) / folder.name
            copy_photos(folder, copy, options.every, options.side)
            start = sum(os.times()[:4])  # with child processes
            try:
                result = motion.find_cameras(copy, lambda *_: None)
            except InputError as error:
                print(f"{folder.name}: {error}")
                continue
            seconds = sum(os.times()[:4]) - start
            found = rotations(copy)
        names = sorted(found.keys() & given.keys())
        errors = rotation_errors(np.array([found[n] for n in names]), np.array([given[n] for n in names]))
        figures = (f"{value:.2f}" for value in (errors.mean(), np.median(errors), errors.max()))
        masks_only = "yes" if result["inside"] else "no"
        within, features = (errors < 1).sum(), "learned" if result["learned"] else "SIFT"
        counts = result["photos"], result["placed"]
        print(row(folder.name, *counts, *figures, within, masks_only, features, f"{seconds:.0f}"), flush=True)
