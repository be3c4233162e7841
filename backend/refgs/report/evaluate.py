"""A run's figures: its views against photos, and what it recovered against ground truth where there is some."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from refgs.camera import Camera
from refgs.capture import LoadedView, View, load_view, published_normals
from refgs.capture.poses import split_similarity
from refgs.color import srgb_encode
from refgs.errors import InputError
from refgs.export.environment import directions, read_environment, read_exr, sample
from refgs.export.mesh import read_glb
from refgs.geometry.mesh import Mesh, read_mesh
from refgs.kernels import cuda
from refgs.model.environment import Environment
from refgs.model.surfels import Surfels
from refgs.render.renderer import render
from refgs.report import metrics, surface
from refgs.report.pictures import as_bytes, maps, over_white, picture, write_png
from refgs.run import Run
from refgs.train.trainer import composite

PANORAMA = 256  # rows of the pictures of the light
FRAMES = 20  # of which the speed is the median
_PASSES = ("normal", "albedo", "roughness", "metallic", "visibility")

Step = Callable[[int, str, int], None]
"""Called with how many are done, a few words, and of how many."""


class GroundTruth:
    """A folder of what is known of a capture, brought into the run's frame; what is there is measured, every part is optional.

    light.exr; mesh.ply; normal, albedo, roughness, metallic, visibility/NAME.exr of the views with alpha/NAME.exr;
    relight/HDRI.exr with relight/HDRI/NAME.exr (see `benchmarks.scenes.capture`).
    """

    def __init__(self, folder: Path, to_capture: np.ndarray):
        self.folder, self._to_run = folder, np.linalg.inv(to_capture)
        self._turn = self._to_run[:3, :3] / np.cbrt(np.linalg.det(self._to_run[:3, :3]))
        self.passes = [name for name in _PASSES if (folder / name).is_dir()]
        relit = (folder / "relight").iterdir() if (folder / "relight").is_dir() else ()
        self.hdris = sorted({file.stem for file in relit if file.is_dir() or file.suffix == ".exr"})
        self.has_light, self.has_mesh = ((folder / name).exists() for name in ("light.exr", "mesh.ply"))
        if not (self.passes or self.hdris or self.has_light or self.has_mesh):
            known = ", ".join([f"{name}/" for name in _PASSES] + ["relight/", "light.exr", "mesh.ply"])
            raise InputError(f"{folder}: there is no ground truth in it; known are {known}")

    def maps(self, camera: Camera) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """All passes of a view that there are, and its coverage."""
        if not self.passes:
            return {}, np.zeros((camera.height, camera.width), np.float32)
        return {name: self.view(name, camera) for name in self.passes}, self.view("alpha", camera)

    def view(self, name: str, camera: Camera) -> np.ndarray:
        """A pass of a view, float32 (h, w) or (h, w, channels)."""
        file = self.folder / name / f"{camera.name}.exr"
        pixels = read_exr(file)
        if pixels.shape[:2] != (camera.height, camera.width):
            raise InputError(f"{file}: its size is not the view's ({camera.width}×{camera.height})")
        channels = {"normal": 3, "albedo": 3}.get(name, 1)
        if pixels.ndim == 2 and channels > 1:
            raise InputError(f"{file}: it has one channel where there should be {channels}")
        if channels == 1:
            return pixels if pixels.ndim == 2 else pixels[..., 0]
        return pixels[..., :3] @ self._turn.T.astype(np.float32) if name == "normal" else pixels[..., :3]

    def panorama(self, name: str) -> np.ndarray:
        """A light, equirectangular in Blender's orientation."""
        panorama = read_environment(self.folder / f"{name}.exr")
        return sample(panorama, directions(*panorama.shape[:2]) @ self._turn.astype(np.float32))

    def mesh(self) -> Mesh:
        mesh = read_mesh(self.folder / "mesh.ply")
        return Mesh(mesh.vertices @ self._to_run[:3, :3].T + self._to_run[:3, 3], mesh.faces)

    def relit(self, hdri: str, camera: Camera) -> np.ndarray:
        """A view under another light, premultiplied linear RGBA."""
        file = self.folder / "relight" / hdri / f"{camera.name}.exr"
        return read_relit(file, (camera.height, camera.width))


def read_relit(file: Path, size: tuple[int, int] | None = None) -> np.ndarray:
    """A picture of premultiplied linear RGBA of this height and width. Raises InputError where it is none."""
    pixels = read_exr(file)
    if pixels.ndim != 3 or pixels.shape[2] != 4:
        raise InputError(f"{file} has no alpha: an RGBA picture is needed to put it over a background")
    if size is not None and pixels.shape[:2] != size:
        raise InputError(f"{file} is {pixels.shape[1]}×{pixels.shape[0]}, it should be {size[1]}×{size[0]}")
    return pixels


def evaluate(run: Run, split: str, views: list[View], truth: GroundTruth | None, step: Step) -> dict[str, Any]:
    """Measure a run on views of its capture and against ground truth; write pictures/ of both. Returns the figures."""
    pictures, lit = run.folder / "pictures", run.environment is not None
    hdris = truth.hdris if truth and lit else []
    total, done, cameras = len(views) * (1 + 2 * len(hdris)), 0, []

    def next_step(note: str) -> None:
        nonlocal done
        done += 1
        step(done, note, total)

    rows: dict[str, list] = {}
    without_lpips = metrics.lpips_missing()
    for view in views:
        loaded = load_view(view, run.settings.image.max_side)
        figures = _view(run, view, loaded, truth, pictures / split, without_lpips is None)
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
        found |= _light(run, truth, pictures)
    for hdri in hdris:
        figures = _relit(run, hdri, cameras, truth, pictures / "relight", next_step)
        found.setdefault("relight", {})[hdri] = {"refgs": figures}
    if truth and truth.has_mesh and (run.folder / "mesh.glb").exists():
        mesh = read_glb(run.folder / "mesh.glb")
        found["mesh"] = surface.compare(mesh, truth.mesh(), run.training_cameras())
    return found | {"views": len(views), "split": split, "splats": len(run.splats)} | _speed(run, cameras)


def _view(
    run: Run, view: View, loaded: LoadedView, truth: GroundTruth | None, pictures: Path, with_lpips: bool
) -> dict[str, Any]:
    """The figures of one view, and its pictures. Where no pass of it is in the ground truth, the normals that its data set
    brings are the truth."""
    camera, background = loaded.camera, np.array(run.settings.image.background, dtype=np.float32)
    rendering = run.render(camera)
    color = np.clip(rendering.color.numpy(), 0, 1)
    if any(run.settings.region.size):  # the photo shows more than is wanted: only what the run covers of it is compared
        shown = np.rint(255 * rendering.alpha.numpy()).astype(np.uint8)
        loaded = replace(loaded, alpha=shown if loaded.alpha is None else np.minimum(shown, loaded.alpha))
    photo = composite(loaded, torch.from_numpy(background)).numpy()
    figures = {measure.__name__: measure(color, photo) for measure in (metrics.psnr, metrics.ssim, metrics.flip)}
    if run.exposed and run.settings.render.color_space == "linear":
        # A held-out photo's exposure is not known: it is fitted, in linear radiance, for a second figure.
        exposure = metrics.fitted_exposure(rendering.radiance.numpy(), rendering.alpha.numpy(), photo)
        fitted = run.render(camera, exposure=exposure).color.numpy()
        figures["psnr_exposure_fitted"] = metrics.psnr(np.clip(fitted, 0, 1), photo)
    if with_lpips:
        figures["lpips"] = metrics.lpips(color, photo)
    images = maps(rendering)
    alpha = images["alpha"]

    def write(kind: str, pixels: np.ndarray) -> None:
        write_png(pictures / kind / f"{camera.name}.png", pixels)

    write("photo", as_bytes(photo))
    write("color", as_bytes(color))
    for name in _PASSES:
        if name in images:
            write(name, picture(name, images[name], alpha))
    known, true_alpha = truth.maps(camera) if truth else ({}, np.zeros_like(alpha))
    if not known and (published := published_normals(view, run.settings.image.max_side)):
        turn = split_similarity(run.to_capture)[1].astype(np.float32)
        known, true_alpha = {"normal": published[0] @ turn}, published[1]
    covered = true_alpha >= metrics.COVERED
    for name, true in known.items():
        write(f"true_{name}", picture(name, true, true_alpha))
        if not covered.any():
            continue
        if name == "normal":
            given = images["normal"], true, alpha, true_alpha
            figures["normal_mae_degrees"] = metrics.normal_mae_degrees(*given)
            figures["normal_ssim"] = metrics.normal_ssim(*given)
        elif name == "visibility":
            free, truly = (v[covered] >= 0.5 for v in (images.get(name, np.ones_like(alpha)), true))
            figures |= {"visibility_agreement": float((free == truly).mean()), "visibility_free": float(truly.mean())}
        elif name == "albedo" and name in images:
            figures[name] = metrics.channel_products(images[name], true, covered)
        elif name in images:
            figures[f"{name}_mae"] = float(np.abs(images[name] - true)[covered].mean(dtype=np.float64))
    return figures


def _light(run: Run, truth: GroundTruth | None, pictures: Path) -> dict[str, dict[str, float]]:
    """The recovered panorama's figures, and pictures of it and of the true one at one exposure."""

    def write(name: str, panorama: np.ndarray) -> None:
        small = metrics.resized(panorama, min(PANORAMA, len(panorama)))
        write_png(pictures / f"{name}.png", as_bytes(srgb_encode(small)))

    light = read_environment(run.folder / "environment.exr")
    write("environment", light)
    if truth is None or not truth.has_light or run.settings.light.frame == "camera":  # the true light stands still
        return {}
    true = truth.panorama("light")
    write("environment_truth", true)
    error, scale = metrics.environment_log_rmse(light, true)
    figures: dict[str, float] = {"log_rmse": error, "scale": scale}
    lights = metrics.lights_error(light, true)
    if lights is not None:
        figures |= {"lights_degrees": lights[0], "lights": lights[1]}
    return {"environment": figures}


def _relit(
    run: Run,
    hdri: str,
    cameras: list[Camera],
    truth: GroundTruth,
    pictures: Path,
    next_step: Callable[[str], None],
) -> dict[str, float]:
    """The figures of views under another light, and pictures of both."""
    light = run.light(truth.panorama(f"relight/{hdri}"))

    def pairs() -> Iterator[tuple[np.ndarray, np.ndarray]]:  # rendered again each time: so many pictures aren't kept
        for camera in cameras:
            image, true = maps(run.render(camera, light))["color"], truth.relit(hdri, camera)
            for kind, pixels in (("refgs", image), ("truth", true)):
                write_png(pictures / kind / f"{hdri}_{camera.name}.png", as_bytes(over_white(pixels)))
            yield image, true
            next_step(f"under {hdri}")

    return metrics.relit(pairs)


def _speed(run: Run, cameras: list[Camera]) -> dict[str, float | str]:
    """Frames a second of the renderer on what there is to render with: the median frame's, each waited for."""
    device = torch.device("cuda" if cuda.unusable() is None else "cpu")
    surfels = Surfels(*(value.to(device) for value in run.surfels()))
    light = run.environment and Environment(run.environment.radiance.to(device), run.environment.reference)
    background = torch.tensor(run.settings.image.background, device=device)
    seconds = []
    for i in range(-2, FRAMES):  # the first ones are not counted
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
