"""The light's prefilter: which texels a lobe is summed over, its levels of roughness, their sides, the cubemap's own."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache, partial
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

from benchmarks.approximations import LAMPS, SHARPNESS, Row, rms, room, timed
from benchmarks.splitsum import environment, lobe_mean
from refgs.model import cubemap, prefilter

RESOLUTION = 64
UNIT = "error by mean radiance"


@contextmanager
def changed(**constants):
    """With other constants of the prefilter."""
    with patch.multiple(prefilter, matrices=lru_cache(prefilter.matrices.__wrapped__), **constants):
        yield


def errors(radiance: Tensor, fine: Tensor, rows: int) -> list[float]:
    """Of each level's texels, `rows` of them at random, against the sum of the lobe over a finer cubemap: their RMS as a part
    of the mean."""
    side, fine_side = (math.isqrt(len(v) // 6) for v in (radiance, fine))
    levels = prefilter.prefilter(radiance, side).cpu()
    levels = cubemap.in_texel_order(levels, tuple(prefilter.level_sides(side))).numpy()
    directions, area = cubemap.texel_directions(fine_side).numpy(), cubemap.texel_solid_angles(fine_side).numpy()
    start, found, rng = 6 * side * side, [], np.random.default_rng(0)
    for level_side, lobe in zip(prefilter.level_sides(side)[1:], prefilter.LOBES, strict=True):
        axes = cubemap.texel_directions(level_side).numpy()
        chosen = rng.choice(len(axes), rows, replace=False)
        weight = lobe(axes[chosen] @ directions.T) * area
        expected = weight @ fine.numpy() / weight.sum(axis=1, keepdims=True)
        got = levels[start : start + len(axes)][chosen]
        found.append(float(np.sqrt(((got - expected) ** 2).mean()) / expected.mean()))
        start += len(axes)
    return found


def both_ways(resolution: int) -> float:
    """Milliseconds of prefiltering a cubemap and of its derivative."""
    radiance = torch.rand(6 * resolution**2, 3, requires_grad=True)
    upstream = torch.rand_like(prefilter.prefilter(radiance, resolution))

    def step() -> None:
        torch.autograd.grad(prefilter.prefilter(radiance, resolution), radiance, upstream)

    step()  # which makes the matrices
    return timed(step)[1]


def _texels(name: str, constant: str, settings: tuple, resolution: int, rows: int) -> Iterator[Row]:
    """Levels against direct sums over texels a fourth as wide, the light being even over the cubemap's own."""
    radiance, default = environment(room, resolution).radiance, getattr(prefilter, constant)
    faces = radiance.reshape(6, resolution, 1, resolution, 1, 3)
    fine = faces.expand(6, resolution, 4, resolution, 4, 3).reshape(-1, 3)
    for setting in settings:
        with changed(**{constant: setting}):
            error = rms(np.array(errors(radiance, fine, rows)))
            yield Row(name, "", setting, error, UNIT, both_ways(resolution), setting == default)


def cells(settings: tuple = (16, 64, 256, 1024), resolution: int = RESOLUTION, rows: int = 24) -> Iterator[Row]:
    """Into how many parts a lobe is divided: where a texel has more than one of them, finer ones are summed."""
    yield from _texels("prefilter: parts of a lobe", "CELLS", settings, resolution, rows)


def cut_off(
    settings: tuple = (1e-2, 3e-3, 1e-3, 1e-4, 1e-5, 1e-6), resolution: int = RESOLUTION, rows: int = 24
) -> Iterator[Row]:
    """The least part of a lobe that a texel is kept for."""
    yield from _texels("prefilter: cut-off", "LEAST_SHARE", settings, resolution, rows)


@lru_cache
def directly(count: int, roughest: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions (P, 3), half of them near lamps, roughnesses (P,), and the light about them as such lobes see it (P,)."""
    rng = np.random.default_rng(1)
    directions, lamp = rng.normal(size=(count, 3)), rng.integers(len(LAMPS), size=count // 2)
    directions[: count // 2] = LAMPS[lamp] + 2 * directions[: count // 2] / np.sqrt(SHARPNESS[lamp])[:, None]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    roughness = rng.uniform(0.02, roughest, count)
    return directions, roughness, lobe_mean(room, directions, roughness)


def looked_up(resolution: int, count: int, roughest: float = 1.0) -> float:
    """RMS error of the light at any direction and roughness, by its mean: of texels, levels and what lies between them."""
    directions, roughness, exact = directly(count, roughest)
    light = environment(room, resolution)
    levels = cubemap.in_texel_order(light.levels, light.sides)
    place = torch.from_numpy(prefilter.level_of(roughness)).float()
    # The last one is irradiance.
    specular = levels[: -6 * light.sides[-1] ** 2], light.sides[:-1]
    found = cubemap.sample(*specular, torch.from_numpy(directions).float(), place)
    return rms(found[:, 0].numpy() - exact) / exact.mean()


def cubemaps(settings: tuple = (16, 32, 64, 128, 256), count: int = 400) -> Iterator[Row]:
    for method, roughest in (("any roughness", 1.0), ("below 0.08", 0.08)):
        for side in settings:
            error = looked_up(side, count, roughest)
            yield Row("cubemap: side of a face", method, side, error, UNIT, both_ways(side), side == 128)


def levels(settings: tuple = (3, 4, 7, 13), resolution: int = 128, count: int = 400) -> Iterator[Row]:
    """So many roughnesses, those of today and between them."""
    default = len(prefilter.ROUGHNESS)
    known = np.arange(default), np.array(prefilter.ROUGHNESS)
    for number in settings:
        at = np.linspace(0, default - 1, number)
        roughness = tuple(float(r) for r in np.interp(at, *known))
        divisor = tuple(prefilter.DIVISOR[int(i)] for i in at)
        lobes = (*(partial(prefilter.ggx_lobe, roughness=r) for r in roughness[1:]), prefilter.cosine_lobe)
        with changed(ROUGHNESS=roughness, DIVISOR=divisor, LOBES=lobes):
            error = looked_up(resolution, count)
            yield Row("prefilter: levels", "", number, error, UNIT, both_ways(resolution), number == default)


def sides(settings: tuple = (0.5, 1, 2, 4), resolution: int = 128, count: int = 400) -> Iterator[Row]:
    """Levels so many times as wide as today; none is wider than the cubemap."""
    for factor in settings:
        divisor = tuple(max(1, round(d / factor)) for d in prefilter.DIVISOR)
        least = max(2, int(prefilter.LEAST_SIDE * min(factor, 1)))
        with changed(DIVISOR=(1, *divisor[1:]), LEAST_SIDE=least):
            error = looked_up(resolution, count)
            yield Row("prefilter: sides of levels", "", factor, error, UNIT, both_ways(resolution), factor == 1)
