"""Measure how well masks are made from photos with cameras: `refgs bench masks CAPTURE…`.

Each capture is copied without its masks, and `refgs masks` makes them anew. They are compared with the true ones: the capture's own, or
those in its folder `ground_truth/masks`. A capture without any gets a row without figures; `--sheets` shows its masks to look at.
"""

import argparse
import json
import os
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.harness import call
from refgs.capture import load_view, read_capture
from refgs.capture.images import read_alpha
from refgs.compare.pictures import write_png

SIDE, SHOWN, COLUMNS = 300, 20, 5  # pixels of a picture on a sheet, pictures on it, and in its rows


def true_masks(folder: Path) -> dict[str, np.ndarray]:
    """Read the true masks of a capture, bool (H, W), by the photo's name."""
    truth = folder / "ground_truth" / "masks"
    if truth.is_dir():
        return {file.stem: cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) > 127 for file in truth.glob("*.png")}
    return {v.camera.name: read_alpha(v) > 127 for v in read_capture(folder).views if v.masked}


def without_masks(folder: Path, copy: Path, every: int) -> None:
    """Copy a capture without its masks. Of a capture with a `transforms.json`, copy every so-many-th photo."""
    shutil.copytree(folder, copy, ignore=shutil.ignore_patterns("masks*", "ground_truth"))
    for path in (copy, *copy.rglob("*")):
        path.chmod(path.stat().st_mode | 0o200)
    if (file := copy / "transforms.json").exists():
        data = json.loads(file.read_text())
        data["frames"] = [{k: v for k, v in f.items() if k != "mask_path"} for f in data["frames"][::every]]
        file.write_text(json.dumps(data))


def sheet(folder: Path) -> np.ndarray:
    """Return a contact sheet (H, W, 3) uint8 of some masked photos: what is not the object is darker, and its outline is green."""
    views = [view for view in read_capture(folder).views if view.masked]
    pictures = []
    for index in np.unique(np.linspace(0, len(views) - 1, SHOWN).round().astype(int)):
        view = load_view(views[index], SIDE)
        inside = (view.alpha > 127).astype(np.uint8)
        whole = load_view(replace(views[index], mask_path=None), SIDE).bytes
        picture = np.where(inside[..., None] > 0, whole, whole // 3)
        picture[cv2.morphologyEx(inside, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0] = (0, 255, 0)
        height, width = picture.shape[:2]
        pictures.append(np.pad(picture, ((0, SIDE - height), (0, SIDE - width), (0, 0))))
    pictures += [np.zeros_like(pictures[0])] * (-len(pictures) % COLUMNS)
    rows = [np.hstack(pictures[i : i + COLUMNS]) for i in range(0, len(pictures), COLUMNS)]
    return np.vstack(rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the masks of all captures anew. Print intersection over union (IoU) with the true ones and the CPU time, a row per capture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("captures", type=Path, nargs="+", metavar="CAPTURE")
    parser.add_argument("--every", type=int, default=1, help="use every so-many-th photo (1)")
    parser.add_argument("--sheets", type=Path, metavar="DIR", help="write contact sheets of the masks, as PNG")
    options = parser.parse_args(arguments)
    row = "{:<12} {:>6} {:>8} {:>6} {:>6} {:>10} {:>5}".format
    print(row("capture", "photos", "IoU mean", "median", "worst", "below 0.9", "CPU s"))
    for folder in options.captures:
        truths = true_masks(folder)
        with tempfile.TemporaryDirectory() as scratch:
            copy = Path(scratch) / folder.name
            without_masks(folder, copy, options.every)
            before = os.times()
            if call("masks", copy):
                print(row(folder.name, "", "none", "", "", "", ""))
                continue
            seconds = f"{sum(os.times()[2:4]) - sum(before[2:4]):.0f}"  # of the children
            views = read_capture(copy).views
            overlaps = []
            for view in views:
                if (truth := truths.get(view.camera.name)) is not None:
                    mask = read_alpha(view) > 127
                    overlaps.append((mask & truth).sum() / max((mask | truth).sum(), 1))
            if options.sheets:
                options.sheets.mkdir(parents=True, exist_ok=True)
                write_png(options.sheets / f"{folder.name}.png", sheet(copy))
        figures = [f"{f(overlaps):.3f}" for f in (np.mean, np.median, np.min)] if overlaps else ["", "", ""]
        below = sum(overlap < 0.9 for overlap in overlaps) if overlaps else ""
        print(row(folder.name, len(views), *figures, below, seconds), flush=True)


if __name__ == "__main__":
    main()
