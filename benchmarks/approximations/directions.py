"""Colour by direction and light from the object as harmonics: error of the best fit by degree."""

from collections.abc import Iterator

import numpy as np
import torch
from scipy.special import sph_harm_y

from benchmarks.approximations import Row, room, timed
from benchmarks.approximations.rays import Surface
from benchmarks.kernels import ball
from benchmarks.splitsum import lobe_mean
from refgs.render.directional import directional

SPLATS = 60_000  # of a run by `standard`
NAME = "harmonics: degree"


def basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Real harmonics (P, K) by SciPy."""
    polar, azimuth = np.arccos(directions[:, 2].clip(-1, 1)), np.arctan2(directions[:, 1], directions[:, 0])
    columns = []
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            value = sph_harm_y(n, abs(m), polar, azimuth)
            columns.append(value.real if m >= 0 else value.imag)
    return np.stack(columns, axis=1)


def hemisphere(count: int, rng: np.random.Generator) -> np.ndarray:
    directions = rng.normal(size=(count, 3))
    directions[:, 2] = np.abs(directions[:, 2])
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def fitted(directions: np.ndarray, values: np.ndarray, degree: int) -> tuple[float, float]:
    """Mean square of what the best fit to the first half of the values leaves of the other, and of these."""
    columns, half = basis(directions, degree), len(values) // 2
    weights = np.linalg.lstsq(columns[:half], values[:half], rcond=None)[0]
    return float(np.mean((columns[half:] @ weights - values[half:]) ** 2)), float(np.mean(values[half:] ** 2))


def kernel(degree: int, splats: int) -> float:
    """Milliseconds of the colours of surfels and their derivatives; the kernels have no degree above 3."""
    if degree > 3:
        return float("nan")
    (positions, *_), camera = ball(splats)
    constant = torch.rand(splats, 1, 3, requires_grad=True)
    rest = torch.rand(splats, (degree + 1) ** 2 - 1, 3, requires_grad=True)
    upstream = torch.rand(splats, 3)

    def step() -> None:
        torch.autograd.grad(directional(constant, rest, 0.5, positions, camera), (constant, rest), upstream)

    return timed(step)[1]


def degrees(
    settings: tuple = (0, 1, 2, 3, 4),
    count: int = 800,
    points: int = 64,
    splats: int = SPLATS,
    roughnesses: tuple = (0.2, 0.4, 0.7),
) -> Iterator[Row]:
    """What metals of some roughness send to all sides of a room with lamps; and what a ball gets of another beside it, from all the
    directions where that is. RMS error by the RMS."""
    rng, unit = np.random.default_rng(0), "error by RMS"
    views, time = hemisphere(count, rng), [kernel(degree, splats) for degree in settings]
    mirrored = views * [-1, -1, 1]
    for roughness in roughnesses:
        values = lobe_mean(room, mirrored, np.full(count, roughness))
        for degree, spent in zip(settings, time, strict=True):
            left, size = fitted(views, values, degree)
            method = f"colour, roughness {roughness:g}"
            yield Row(NAME, method, degree, (left / size) ** 0.5, unit, spent, degree == 3)
    surface = Surface(points)
    ways = hemisphere(10 * count, rng)
    found = []
    for point in range(points):
        free, sent = surface.trace(np.full(len(ways), point), ways @ surface.frame[point])
        if (~free).sum() > 0.05 * len(ways):
            found.append((ways[~free], sent[~free]))
    for degree, spent in zip(settings, time, strict=True):
        left, size = np.mean([fitted(*one, degree) for one in found], axis=0)
        yield Row(NAME, "light from the object", degree, (left / size) ** 0.5, unit, spent, degree == 3)
