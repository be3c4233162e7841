"""Evaluate a run: compare its views with photos, and its maps, light and mesh with ground truth if there is any."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from refgs.camera import Camera
from refgs.capture import LoadedView, View, load_view
from refgs.color import srgb_encode
from refgs.compare import metrics, surface
from refgs.compare.pictures import as_bytes, composite, maps, over_white, picture, write_png
from refgs.compare.truth import PASSES, GroundTruth, errors, known_maps
from refgs.formats.gltf import read_glb
from refgs.formats.panorama import read_environment
from refgs.kernels import cuda
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.align import fitted
from refgs.render.baselines import method_of
from refgs.render.rasterize import rasterize
from refgs.render.renderer import render
from refgs.render.rendering import COVERED
from refgs.render.volume import discs
from refgs.report import published
from refgs.run import Run

PANORAMA = 256  # rows of the light's pictures, at most
FRAMES = 20  # timed; the speed is their median

Step = Callable[[int, str, int], None]
"""Called with the number done, a note, and the total."""


def evaluate(run: Run, split: str, views: list[View], truth: GroundTruth | None, step: Step) -> dict[str, Any]:
    """Compare a run with the photos of `views`, and with ground truth if it is given. Returns the metrics for metrics.json, such as PSNR.

    Some ground truth belongs to a published data set. In that case, the run is also measured by that data set's protocol
    (`refgs.report.published`), and it is rendered only under the other lights that the protocol names.

    Writes pictures into the run's folder:

    - pictures/`split`: the views. `split` is "test" for held-out views, "train" for training views.
    - pictures: the light
    - pictures/relight: the run under other lights

    After each rendering, `step` is called with the number of renderings that are done, a note, and their total number.
    """
    pictures, lit = run.folder / "pictures", run.environment is not None
    by_protocol = published.steps(truth, len(views)) if lit else 0  # how often the data set's protocol renders
    hdris = truth.hdris if truth and lit and not by_protocol else []
    total, done, cameras = len(views) * (1 + 2 * len(hdris)) + by_protocol, 0, []

    def next_step(note: str) -> None:
        nonlocal done
        done += 1
        step(done, note, total)

    rows: dict[str, list] = {}
    without_lpips = metrics.lpips_missing()
    refined = {camera.name: camera for camera in run.training_cameras()} if run.refined else {}
    for view in views:
        loaded = load_view(view, run.settings.image.max_side)
        if split == "train" and run.refined:
            loaded = replace(loaded, camera=refined[loaded.camera.name])
        figures = _measure_view(run, view, loaded, truth, pictures / split, without_lpips is None)
        for name, value in figures.items():
            rows.setdefault(name, []).append(value)
        cameras.append(loaded.camera)
        next_step("views")
    found: dict[str, Any] = {}
    if "albedo" in rows:
        found["albedo"] = metrics.aligned_psnr(rows.pop("albedo"))
    found = {name: float(np.mean(values)) for name, values in rows.items()} | found
    found = {"lpips": None} | found | {"lpips_reason": without_lpips}
    if lit:
        found |= _measure_light(run, truth, pictures)
    if truth:
        for hdri in hdris:
            figures = _measure_relit(run, hdri, cameras, truth, pictures / "relight", next_step)
            found.setdefault("relight", {})[hdri] = {"refgs": figures}
    if by_protocol:
        found |= published.measure(run, views, truth, pictures / "relight", next_step)
    if truth and truth.has_mesh and (run.folder / "mesh.glb").exists():
        mesh = read_glb(run.folder / "mesh.glb")
        found["mesh"] = surface.compare(mesh, truth.mesh(), run.training_cameras())
    return found | {"views": len(views), "split": split, "splats": len(run.splats)} | _measure_speed(run, cameras)


def _measure_view(
    run: Run, view: View, loaded: LoadedView, truth: GroundTruth | None, pictures: Path, with_lpips: bool
) -> dict[str, Any]:
    """Render a view, write its pictures to `pictures`, and return its metrics."""
    camera, background = loaded.camera, np.array(run.settings.image.background, dtype=np.float32)
    rendering = run.render(camera)
    color = np.clip(rendering.color.numpy(), 0, 1)
    if any(run.settings.region.size):  # compare only what the run covers: the photo shows more than the region
        shown = np.rint(255 * rendering.alpha.numpy()).astype(np.uint8)
        loaded = replace(loaded, alpha=shown if loaded.alpha is None else np.minimum(shown, loaded.alpha))
    photo = composite(loaded, torch.from_numpy(background)).numpy()
    figures = {measure.__name__: measure(color, photo) for measure in (metrics.psnr, metrics.ssim, metrics.flip)}
    if run.exposed and not method_of(run.settings.render).light.display:
        # A held-out photo's exposure is unknown: fit it, in linear radiance, for a second figure.
        exposure = metrics.fitted_exposure(rendering.radiance.numpy(), rendering.alpha.numpy(), photo)
        exposed = run.render(camera, exposure=exposure).color.numpy()
        figures["psnr_exposure_fitted"] = metrics.psnr(np.clip(exposed, 0, 1), photo)
    if run.refined and view.split == "test":  # its pose was not refined: fit it, for a second figure
        moved = fitted(run.render, camera, torch.from_numpy(photo), run.centre, run.radius)
        figures["psnr_pose_fitted"] = metrics.psnr(np.clip(run.render(moved).color.numpy(), 0, 1), photo)
    if with_lpips:
        figures["lpips"] = metrics.lpips(color, photo)
    images = maps(rendering)
    alpha = images["alpha"]

    def write(kind: str, pixels: np.ndarray) -> None:
        write_png(pictures / kind / f"{camera.name}.png", pixels)

    write("photo", as_bytes(photo))
    write("color", as_bytes(color))
    for name in PASSES:
        if name in images:
            write(name, picture(name, images[name], alpha))
    if run.splats.doubt is not None:
        write("doubt", picture("doubt", _doubt(run, camera), alpha))
    known, true_alpha = known_maps(truth, view, camera, run.to_capture)
    for name, true in known.items():
        write(f"true_{name}", picture(name, true, true_alpha))
    figures |= errors(images, known, true_alpha)
    if "normal_mae_degrees" in figures:
        figures["normal_ssim"] = metrics.normal_ssim(images["normal"], known["normal"], alpha, true_alpha)
    return figures


def _doubt(run: Run, camera: Camera) -> np.ndarray:
    """Render the splats' `doubt` (H, W) in 0..1; `run.splats.doubt` must not be None."""
    feature = torch.from_numpy(run.splats.doubt)[:, None]
    drawn = rasterize(*discs(run.surfels(), camera), feature, camera, near=run.near)
    return (drawn.features[..., 0] / drawn.alpha.clamp_min(COVERED)).numpy()


def _measure_light(run: Run, truth: GroundTruth | None, pictures: Path) -> dict[str, dict[str, float]]:
    """Compare the recovered with the true light, if possible, and write both as pictures."""
    # A light that turns with the camera cannot be compared.

    def write(name: str, panorama: np.ndarray) -> None:
        small = metrics.resized(panorama, min(PANORAMA, len(panorama)))
        write_png(pictures / f"{name}.png", as_bytes(srgb_encode(small)))

    light = read_environment(run.folder / "environment.exr")
    write("environment", light)
    # A light that turns with the camera has no counterpart: the true one is fixed in the world.
    if truth is None or not truth.has_light or run.settings.light.frame == "camera":
        return {}
    true = truth.panorama("light")
    write("environment_truth", true)
    error, scale = metrics.environment_log_rmse(light, true)
    figures: dict[str, float] = {"log_rmse": error, "scale": scale}
    if (lights := metrics.lights_error(light, true)) is not None:
        figures |= {"lights_degrees": lights[0], "lights": lights[1]}
    return {"environment": figures}


def _measure_relit(
    run: Run, hdri: str, cameras: list[Camera], truth: GroundTruth, pictures: Path, next_step: Callable[[str], None]
) -> dict[str, float]:
    """Return the metrics of the views under the light `hdri`, and write the pictures."""
    light = run.light(truth.panorama(f"relight/{hdri}"))

    # Each call renders again, because keeping all pictures takes too much memory.
    def pairs() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for camera in cameras:
            image, true = maps(run.render(camera, light))["color"], truth.relit(hdri, camera)
            for kind, pixels in (("refgs", image), ("truth", true)):
                write_png(pictures / kind / f"{hdri}_{camera.name}.png", as_bytes(over_white(pixels)))
            yield image, true
            next_step(f"under {hdri}")

    return metrics.relit(pairs)


def _measure_speed(run: Run, cameras: list[Camera]) -> dict[str, float | str]:
    """Measure `frames_per_second`, and name `frames_device`: the CUDA card or "cpu"."""
    device = torch.device("cuda" if cuda.unusable() is None else "cpu")
    surfels = Surfels(*(value.to(device) for value in run.surfels()))
    light = run.environment and Environment(run.environment.radiance.to(device), run.environment.reference)
    background = torch.tensor(run.settings.image.background, device=device)
    seconds = []
    for i in range(-2, FRAMES):  # frames below 0 warm up
        started = time.perf_counter()
        with torch.no_grad():
            camera = cameras[i % len(cameras)]
            render(surfels, light, camera, background, run.settings.render, run.near, run.occluder)
        if device.type == "cuda":
            torch.cuda.synchronize()
        if i >= 0:
            seconds.append(time.perf_counter() - started)
    name = torch.cuda.get_device_name() if device.type == "cuda" else "cpu"
    return {"frames_per_second": 1 / float(np.median(seconds)), "frames_device": name}
