"""What `refgs check` says about a capture."""

from collections import Counter

import numpy as np

from refgs.capture.images import LoadedView, load_view
from refgs.capture.types import Capture, View
from refgs.errors import InputError

LAYOUTS = {
    "nerf-blender": "NeRF-Blender",
    "nerfstudio": "nerfstudio / instant-ngp",
    "colmap": "COLMAP",
    "nero": "NeRO's Glossy Synthetic",
}


def describe(capture: Capture) -> list[str]:
    """Lines about what the capture holds, then one `Warning: …` line for each thing that looks wrong.

    Decodes every photo and mask. Raises InputError where any cannot be read: how many, and the first.
    """
    statistics = _decode_all(capture)
    return [
        f"Layout: {LAYOUTS[capture.layout]}",
        f"Views: {len(capture.views)}, {len(capture.train_views)} to train on, {len(capture.test_views)} to test on",
        _sizes(capture),
        _lenses(capture),
        _masks(capture, statistics),
        _poses(capture),
        _extent(capture),
        f"Taken for {'an object' if capture.bounded else 'a room or open scene'}: {capture.bounded_because}",
        *(f"Warning: {warning}" for warning in [*capture.warnings, *_warnings(capture, statistics)]),
    ]


class _Statistics:
    """What decoding one photo told: mask coverage (None without one), clipped share, mean code value, greyscale."""

    def __init__(self, loaded: LoadedView):
        inside = np.ones(loaded.image.shape[:2], bool) if loaded.alpha is None else loaded.alpha > 127
        pixels = loaded.image[inside] if inside.any() else np.zeros((1, 3), np.uint8)
        self.coverage = None if loaded.alpha is None else float(inside.mean())
        self.clipped = float((pixels.max(axis=1) >= 254).mean())
        self.brightness = float(pixels.mean())
        self.grey = bool((pixels.max(axis=1) == pixels.min(axis=1)).all())


def _decode_all(capture: Capture) -> list[_Statistics]:
    statistics, broken = [], []
    for view in capture.views:
        try:
            statistics.append(_Statistics(load_view(view, 512)))
        except InputError as error:
            broken.append(str(error))
    if broken:
        count = f"{len(broken)} of {len(capture.views)} views cannot be read, the first: " if len(broken) > 1 else ""
        raise InputError(count + broken[0])
    return statistics


def _sizes(capture: Capture) -> str:
    sizes = Counter((view.camera.width, view.camera.height) for view in capture.views).most_common()
    named = ", ".join(f"{width}×{height}" + (f" ({n})" if len(sizes) > 1 else "") for (width, height), n in sizes[:4])
    return f"Sizes: {named} pixels" + (f" and {len(sizes) - 4} other sizes" if len(sizes) > 4 else "")


def _lenses(capture: Capture) -> str:
    angles = [2 * np.degrees(np.arctan(view.camera.width / 2 / view.camera.fx)) for view in capture.views]
    distorted = sum(view.lens is not None for view in capture.views)
    line = f"Lens: {_span(angles, '.1f')}° wide"
    return line + (f", distortion removed from {distorted} views on loading" if distorted else ", no distortion")


def _masks(capture: Capture, statistics: list[_Statistics]) -> str:
    coverage = [s.coverage for s in statistics if s.coverage is not None]
    if not coverage:
        return "Masks: none"
    alpha = sum(view.has_alpha for view in capture.views)
    kind = "the photos' alpha" if alpha == len(coverage) else "mask files" if alpha == 0 else "mask files and alpha"
    return (
        f"Masks: {len(coverage)} views ({kind}), covering {_span([100 * c for c in coverage], '.0f')} % of the picture"
    )


def _poses(capture: Capture) -> str:
    offset = np.array([view.camera.position for view in capture.views]) - capture.centre
    distance = np.linalg.norm(offset, axis=1)
    elevation = np.degrees(np.arcsin(np.clip(offset[:, 2] / np.maximum(distance, 1e-12), -1, 1)))
    azimuth = np.sort(np.degrees(np.arctan2(offset[:, 1], offset[:, 0])))
    gap = np.diff(np.append(azimuth, azimuth[0] + 360)).max()
    return (
        f"Poses: {_span(distance / capture.radius, '.2g')} radii from the centre, {_span(elevation, '.0f')}° above it, "
        f"{360 - gap:.0f}° around it"
    )


def _extent(capture: Capture) -> str:
    centre = capture.to_capture @ np.append(capture.centre, 1)
    radius = capture.radius * np.cbrt(np.linalg.det(capture.to_capture[:3, :3]))
    x, y, z = centre[:3]
    line = f"Extent: radius {radius:.3g} about ({x:.3g}, {y:.3g}, {z:.3g}) in the capture's frame"
    return line if capture.points is None else f"{line}, {len(capture.points):,} structure-from-motion points"


def _warnings(capture: Capture, statistics: list[_Statistics]) -> list[str]:
    warnings = []

    def count(what: str, views: list[View]) -> None:
        if views:
            warnings.append(f"{len(views)} of {len(capture.views)} views {what}, first {views[0].image_path.name}")

    pairs = list(zip(capture.views, statistics, strict=True))
    if any(view.masked for view in capture.views):
        count("have no mask", [view for view in capture.views if not view.masked])
    count("have an empty mask", [view for view, s in pairs if s.coverage == 0])
    count("are greyscale", [view for view, s in pairs if s.grey and s.coverage != 0])
    count("are clipped to white over a tenth of the subject", [view for view, s in pairs if s.clipped > 0.1])
    count("do not see the centre", [view for view in capture.views if not _sees(view, capture.centre)])
    brightness = [s.brightness for s in statistics if s.coverage != 0]
    if brightness and max(brightness) > 2 * max(1.0, np.median(brightness)):
        brightest = max(pairs, key=lambda pair: pair[1].brightness)[0].image_path.name
        warnings.append(f"exposure varies: {brightest} is more than twice as bright as most")
    if not capture.masked and capture.bounded:
        warnings.append("no masks: the surroundings will be reconstructed with the object")
    if len(capture.train_views) < 20:
        warnings.append(f"{len(capture.train_views)} training views are few; thirty or more are good")
    if not capture.test_views:
        warnings.append("no test views: the training cannot be measured")
    return warnings


def _sees(view: View, point: np.ndarray) -> bool:
    camera = view.camera
    x, y, z = camera.world_to_camera[:3, :3] @ point + camera.world_to_camera[:3, 3]
    if z <= 0:
        return False
    return 0 <= camera.fx * x / z + camera.cx <= camera.width and 0 <= camera.fy * y / z + camera.cy <= camera.height


def _span(values, layout: str) -> str:
    low, high = format(min(values), layout), format(max(values), layout)
    return low if low == high else f"{low} to {high}"
