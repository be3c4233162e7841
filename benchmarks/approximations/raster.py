"""The rasteriser's cut-offs, its screen-space filter and its precision, against the float64 reference.

The constants are compiled in: for each setting the rasteriser's sources are compiled anew, into the cache of the kernels.
"""

import functools
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

from benchmarks.approximations import Row, rms, timed
from benchmarks.kernels import ball
from refgs.camera import Camera
from refgs.kernels import build, load, reference
from refgs.model.surfels import quaternions_towards
from refgs.render.rasterize import rasterize

SOURCES, HEADERS = ("project.cpp", "blend.cpp"), ("splat.h", "raster.h")
NEAR, UNIT = 0.1, "error by the picture's RMS"
LIFTED = {"ALPHA_CUT": 1e-9, "MIN_TRANSMITTANCE": 1e-12, "LOW_PASS": 1e6}  # as good as not there


@contextmanager
def compiled(**constants: float):
    """With a rasteriser in which these constants of its headers are others."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "kernels"
        shutil.copytree(build.HERE, copy, ignore=shutil.ignore_patterns("__pycache__"))
        headers = {header: (copy / header).read_text(encoding="utf-8") for header in HEADERS}
        for name, value in constants.items():
            pattern, found = rf"(constexpr float {name} = )[^;]*", 0
            for header, text in headers.items():
                headers[header], count = re.subn(pattern, rf"\g<1>(float){value!r}", text)
                found += count
            assert found == 1, f"{name}: {found} definitions"
        for header, text in headers.items():
            (copy / header).write_text(text, encoding="utf-8")
        fresh = functools.cache(load._load.__wrapped__)
        with patch.multiple(build, HERE=copy, SOURCES=SOURCES), patch.object(load, "_load", fresh):
            yield


def scene(splats: int, side: int, size: float = 1.0) -> tuple[list[Tensor], Camera]:
    """The ball of `benchmarks.kernels`, some of its discs opaque and most faint, as they are after a training, and so many times as
    large."""
    surfels, camera = ball(splats, side, 3)
    surfels[2] = size * surfels[2]
    surfels[3] = torch.from_numpy(np.random.default_rng(2).beta(0.6, 1.4, splats).clip(0.01, 0.99)).float()
    return surfels, camera


def seen_from_the_edge(splats: int, side: int) -> tuple[list[Tensor], Camera]:
    """The same with discs three times as large that nearly hold the camera in their planes."""
    surfels, camera = scene(splats, side, 3.0)
    rng, sight = np.random.default_rng(4), surfels[0].double().numpy() - camera.position
    normals = np.cross(sight, rng.normal(size=(splats, 3)))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals += 10.0 ** rng.uniform(-5, -1, (splats, 1)) * sight
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    surfels[1] = torch.from_numpy(quaternions_towards(normals)).float()
    return surfels, camera


def exactly(
    surfels: list[Tensor], camera: Camera, fine: int = 1, kind: torch.dtype = torch.float64, **constants: float
) -> tuple[Tensor, Tensor]:
    """The reference's features (H, W, C), with other constants, the mean over `fine`² rays a pixel; and how far each of these
    (H fine, W fine) is from a comparison that rounding could turn."""
    large = camera.resized(fine * camera.width, fine * camera.height)
    rows, parts = max(1, 2_000_000 // (large.width * len(surfels[0]))), []
    with torch.no_grad(), ExitStack() as stack:
        for name, value in constants.items():
            stack.enter_context(patch.object(reference, name, value))
        for top in range(0, large.height, rows):  # at a time what memory holds
            part = replace(large, height=min(rows, large.height - top), cy=large.cy - top)
            features, *_, margin = reference.rasterize(*(v.to(kind) for v in surfels), part, NEAR)
            parts.append((features, margin))
    picture, margin = (torch.cat(part).double() for part in zip(*parts, strict=True))
    return picture.reshape(camera.height, fine, camera.width, fine, -1).mean(dim=(1, 3)), margin


def drawn(surfels: list[Tensor], camera: Camera) -> tuple[Tensor, float]:
    """The kernels' features and the milliseconds of the picture and its derivatives."""
    inputs = [v.clone().requires_grad_() for v in surfels]
    side, channels = (camera.height, camera.width), surfels[4].shape[1]
    upstream = [torch.rand(*side, channels), torch.rand(side), torch.rand(side)]

    def step() -> Tensor:
        raster = rasterize(*inputs, camera, near=NEAR)
        torch.autograd.grad(raster, inputs, upstream)
        return raster.features.detach()

    step()  # which loads, or compiles
    return timed(step)


def _constant(name: str, constant: str, settings: tuple, exact: Tensor, given: tuple) -> Iterator[Row]:
    default, size = getattr(reference, constant), rms(exact.numpy())
    for setting in settings:
        with nullcontext() if setting == default else compiled(**{constant: setting}):
            picture, spent = drawn(*given)
        # A cut-off is told as what is 1 over it, so that finer is more.
        shown = setting if constant == "LOW_PASS" else round(1 / setting)
        error = rms((picture - exact).numpy()) / size
        yield Row(name, "", shown, error, UNIT, spent, setting == default)


def footprint(
    settings: tuple = (1 / 16, 1 / 64, 1 / 255, 1 / 1020, 1 / 4080), splats: int = 4000, side: int = 96
) -> Iterator[Row]:
    """Below which alpha a disc ends, and with it its bounding box."""
    given = scene(splats, side)
    exact, _ = exactly(*given, ALPHA_CUT=LIFTED["ALPHA_CUT"])
    yield from _constant("footprint: 1 / alpha's cut-off", "ALPHA_CUT", settings, exact, given)


def transmittance(
    settings: tuple = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5), splats: int = 4000, side: int = 96
) -> Iterator[Row]:
    """Below which transmittance a pixel is finished; discs that lie many deep."""
    given = scene(splats, side, 3.0)
    exact, _ = exactly(*given, MIN_TRANSMITTANCE=LIFTED["MIN_TRANSMITTANCE"])
    yield from _constant("1 / least transmittance", "MIN_TRANSMITTANCE", settings, exact, given)


def low_pass(
    settings: tuple = (0.5, 1.0, 2.0, 4.0, 8.0, 32.0),
    sizes: tuple = (1.0, 0.25),
    splats: int = 1000,
    side: int = 48,
    fine: int = 5,
) -> Iterator[Row]:
    """1 / the variance of the filter, in pixels⁻², against the mean over a pixel of discs without any; discs as wide as they are apart,
    and small ones."""
    for size in sizes:
        given = scene(splats, side, size)
        exact, _ = exactly(*given, fine, LOW_PASS=LIFTED["LOW_PASS"])
        sigma = float(given[0][2].mean()) * given[1].fx / 4
        for row in _constant("low-pass: 1 / variance", "LOW_PASS", settings, exact, given):
            yield row._replace(method=f"discs of {sigma:.1f} pixels")


def precision(splats: int = 2000, side: int = 64, splits: tuple = (1e30, 32.0, 0.0)) -> Iterator[Row]:
    """Discs along a ball, and such as are seen from the edge, which float32 is worst at: the coefficients of none, some or all are taken
    apart into two floats; and the reference as float32 and as float64. Pixels on which a comparison hangs that rounding could turn are
    left out."""
    name, unit = "precision", "error by the picture's RMS"
    names = {1e30: "float32", 32.0: "two, where needed", 0.0: "two floats"}
    for what, given in (("ball", scene(splats, side)), ("from the edge", seen_from_the_edge(splats, side))):
        (exact, margin), spent = timed(exactly, *given, seconds=0)
        safe, size = margin > 1e-3, rms(exact.numpy())
        (rough, _), rough_spent = timed(exactly, *given, 1, torch.float32, seconds=0)
        pictures = []
        for split in splits:
            with nullcontext() if split == 32.0 else compiled(SPLIT=split):
                pictures.append(("kernels, both ways", names[split], *drawn(*given)))
        pictures += [("torch", "float32", rough, rough_spent), ("torch", "float64", exact, spent)]
        for method, setting, picture, took in pictures:
            error = rms((picture - exact)[safe].numpy()) / size
            yield Row(name, f"{method}, {what}", setting, error, unit, took, setting == names[32.0])
