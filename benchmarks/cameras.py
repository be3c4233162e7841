"""Measure how well cameras are found from photos alone: `refgs bench cameras --captures DIR`.

DIR has captures with cameras. Each is copied without them, `refgs poses` finds them anew, and they are compared with the given ones.
"""

import argparse
import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.harness import find_captures
from refgs.capture import read_capture
from refgs.capture.motion import find_cameras
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


def main(arguments: Sequence[str] | None = None) -> None:
    """Find the cameras of all captures in a folder anew. Print how many were placed, their errors and the time, a row per capture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--captures", type=Path, required=True, help="folder with captures that have cameras")
    options = parser.parse_args(arguments)
    row = "{:<12} {:>6} {:>6} {:>7} {:>8} {:>9} {:>9} {:>10} {:>5}".format
    print(row("capture", "photos", "placed", "mean °", "median °", "largest °", "within 1°", "masks only", "s"))
    for folder in find_captures(options.captures):
        given = rotations(folder)
        with tempfile.TemporaryDirectory() as scratch:
            copy = Path(scratch) / folder.name
            for part in ("images", "masks"):
                if (folder / part).is_dir():
                    shutil.copytree(folder / part, copy / part)
            start = time.perf_counter()
            try:
                result = find_cameras(copy, lambda *_: None)
            except InputError as error:
                print(f"{folder.name}: {error}")
                continue
            seconds = time.perf_counter() - start
            found = rotations(copy)
        names = sorted(found.keys() & given.keys())
        errors = rotation_errors(np.array([found[n] for n in names]), np.array([given[n] for n in names]))
        figures = (f"{value:.2f}" for value in (errors.mean(), np.median(errors), errors.max()))
        masks_only = "yes" if result["inside"] else "no"
        within = (errors < 1).sum()
        print(
            row(folder.name, result["photos"], result["placed"], *figures, within, masks_only, f"{seconds:.0f}"),
            flush=True,
        )
