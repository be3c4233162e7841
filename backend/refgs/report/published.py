"""Evaluate a run on a published data set by its authors' protocol (`refgs.compare.protocols`), to compare with published figures."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from refgs.camera import Camera
from refgs.capture import LoadedView, View, load_view
from refgs.color import srgb_decode, srgb_encode
from refgs.compare import metrics, protocols
from refgs.compare.pictures import as_bytes, maps, write_png
from refgs.compare.published import StanfordORBTruth, TensoIRTruth
from refgs.compare.truth import GroundTruth
from refgs.render.renderer import Rendering
from refgs.run import Run
from refgs.spread import spread

RATIO_VIEWS = 20  # by which TensoIR corrects base colour, evenly chosen; pictures of these are written


def steps(truth: GroundTruth | None, views: int) -> int:
    """Return how many renderings `measure` makes of a run with this number of test `views`."""
    if isinstance(truth, TensoIRTruth):
        ratio = min(views, RATIO_VIEWS) if "albedo" in truth.passes else 0
        return ratio + (views if truth.passes else 0) + views * len(truth.hdris)
    return views + len(truth.novel_views()) if isinstance(truth, StanfordORBTruth) else 0


def measure(
    run: Run, views: list[View], truth: GroundTruth | None, pictures: Path, next_step: Callable[[str], None]
) -> dict[str, Any]:
    """Measure a run's test views by the protocol of its data set. Returns {"tensoir": …} or {"stanford_orb": …}, {} for other captures.

    Writes renderings under other lights, and the true pictures, into the folder `pictures`. `next_step` is called with a note after each
    rendering. The run must have materials and a light.
    """
    if isinstance(truth, TensoIRTruth):
        cameras = [view.camera.fitted(run.settings.image.max_side) for view in views]
        return {"tensoir": _tensoir(run, cameras, truth, pictures, next_step)}
    if isinstance(truth, StanfordORBTruth):
        return {"stanford_orb": _stanford_orb(run, views, truth, pictures, next_step)}
    return {}


def _tensoir(
    run: Run, cameras: list[Camera], truth: TensoIRTruth, pictures: Path, next_step: Callable[[str], None]
) -> dict[str, Any]:
    """Measure as TensoIR does, scaling base colours by a `ratio` for each channel."""
    found: dict[str, Any] = {}
    chosen = spread(cameras, RATIO_VIEWS)
    if "albedo" in truth.passes:
        pairs = []
        for camera in chosen:
            known, alpha = truth.maps(camera)
            pairs.append((maps(run.render(camera))["albedo"][alpha > 0], known["albedo"][alpha > 0]))
            next_step("base colour")
        ratio = protocols.albedo_ratio(pairs)
        found["ratio"] = ratio.tolist()
        run = replace(
            run, splats=replace(run.splats, albedo=(run.splats.albedo * ratio).astype(np.float32)), _traced={}
        )
    rows: dict[str, list[float]] = {}
    for camera in cameras if truth.passes else ():
        (known, alpha), images = truth.maps(camera), maps(run.render(camera))
        if "normal" in known:
            pair = images["normal"], images["alpha"], known["normal"], alpha
            rows.setdefault("normal_mae_degrees", []).append(protocols.whole_normal_mae_degrees(*pair))
        if "albedo" in known:
            square = protocols.albedo_square(images["albedo"], known["albedo"], alpha)
            rows.setdefault("albedo", []).append(square)
        next_step("normals and base colour")
    found |= {name: float(np.mean(values)) for name, values in rows.items()}
    if "albedo" in found:
        found["albedo_psnr"] = metrics.decibels(found.pop("albedo"))
    for hdri in truth.hdris:
        found.setdefault("relit", {})[hdri] = _relit_as_tensoir(run, hdri, cameras, chosen, truth, pictures, next_step)
    if "relit" in found:
        lights = list(found["relit"].values())
        found |= {f"relit_{name}": float(np.mean([light[name] for light in lights])) for name in ("psnr", "ssim")}
    return found


def _relit_as_tensoir(
    run: Run,
    hdri: str,
    cameras: list[Camera],
    chosen: list[Camera],
    truth: TensoIRTruth,
    pictures: Path,
    next_step: Callable[[str], None],
) -> dict[str, float]:
    """Return the mean "psnr" and "ssim" under another light, and write `chosen` pictures."""
    light, rows = run.light(truth.panorama(f"relight/{hdri}")), []
    background = np.array(run.settings.image.background, np.float32)
    for camera in cameras:
        image = np.clip(run.render(camera, light).color.numpy(), 0, 1)
        pixels = truth.relit(hdri, camera)
        alpha = pixels[..., 3:]
        true = srgb_encode(pixels[..., :3] / np.maximum(alpha, 1e-6)) * alpha + background * (1 - alpha)
        if camera in chosen:
            _write(pictures, f"{hdri}_{camera.name}", image, true)
        rows.append((metrics.psnr(image, true), metrics.ssim(image, true)))
        next_step(f"under {hdri}")
    return dict(zip(("psnr", "ssim"), np.mean(rows, axis=0).tolist(), strict=True))


def _stanford_orb(
    run: Run, views: list[View], truth: StanfordORBTruth, pictures: Path, next_step: Callable[[str], None]
) -> dict[str, Any]:
    """Measure test views (`view`), other scenes (`light`), normals and depth as Stanford-ORB does."""
    with_lpips, found = metrics.lpips_missing() is None, {}
    rows: dict[str, dict[str, list[float]]] = {"view": {}, "light": {}}
    normals, depths = [], []

    def compare(kind: str, view: View, loaded: LoadedView, image: np.ndarray) -> np.ndarray:
        photo, mask = srgb_decode(loaded.encoded), _mask(loaded)
        figures = protocols.similarity(image, photo, mask, kind == "light", with_lpips)
        if view.image_path.suffix.lower() != ".exr":
            del figures["psnr_h"]
        for name, value in figures.items():
            rows[kind].setdefault(name, []).append(value)
        return photo * mask[..., None]

    for view in views:
        loaded = load_view(view, run.settings.image.max_side)
        camera, mask = loaded.camera, _mask(loaded)
        rendering = run.render(camera)
        compare("view", view, loaded, _radiance(run, rendering))
        if "normal" in truth.passes:
            true = truth.maps(camera)[0]["normal"]
            normals.append(protocols.cosine_distance(maps(rendering)["normal"], true, mask))
        if (depth := truth.depth(camera)) is not None:
            depths.append((rendering.depth.numpy(), depth, mask))
        next_step("views")
    for view in truth.novel_views():
        loaded = load_view(view, run.settings.image.max_side)
        image = _radiance(run, run.render(loaded.camera, run.light(truth.light(view))))
        photo = compare("light", view, loaded, image)
        scale = photo.mean() / max(float((image * _mask(loaded)[..., None]).mean()), 1e-9)  # for people
        _write(pictures, loaded.camera.name, srgb_encode(image * scale), srgb_encode(photo))
        next_step("under other lights")
    for kind, figures in rows.items():
        if figures:
            found[kind] = {name: float(np.mean(values)) for name, values in figures.items()}
    if normals:
        found["normal_cosine_distance"] = float(np.mean(normals))
    if depths:
        found["depth_si_mse"] = protocols.depth_error(depths)
    return found


def _mask(loaded: LoadedView) -> np.ndarray:
    """Return the photo's mask (h, w) in 0..1, all 1 if it has none."""
    shape = loaded.image.shape[:2]
    return np.ones(shape) if loaded.alpha is None else loaded.alpha / 255


def _radiance(run: Run, rendering: Rendering) -> np.ndarray:
    """Convert a rendering over the run's background to linear radiance over black, (h, w, 3)."""
    alpha = rendering.alpha.numpy()[..., None]
    over = rendering.color.numpy() - np.array(run.settings.image.background, np.float32) * (1 - alpha)
    return srgb_decode(np.maximum(over, 0))


def _write(pictures: Path, name: str, image: np.ndarray, true: np.ndarray) -> None:
    for kind, pixels in (("refgs", image), ("truth", true)):
        write_png(pictures / kind / f"{name}.png", as_bytes(pixels))
