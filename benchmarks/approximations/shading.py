"""The split sum against Monte Carlo of the rendering equation."""

from collections.abc import Iterator

import numpy as np
import torch

from benchmarks.approximations import Row, rms, timed
from benchmarks.splitsum import DIELECTRIC, METAL, View, environment, lights, monte_carlo, pixels, shaded
from refgs.render.shade import shade

PIXELS = 4096  # that times are of
CASES = [(r, m) for m in (METAL, DIELECTRIC) for r in (0.1, 0.2, 0.4, 0.7)]
ANGLES = (0, 30, 60)


def split_sum(
    samples: tuple[int, ...] = (3, 12, 48, 192, 768),
    truth: int = 600_000,
    tries: int = 6000,
    pixels_timed: int = PIXELS,
) -> Iterator[Row]:
    """Metal and dielectric of four roughnesses from three angles: relative RMS error. A third of the samples goes to each of three
    densities. The truth of each case has `truth` samples, an estimate is made of `tries` or more in all."""
    for kind in ("gradient", "sun"):
        name, unit = f"split sum under a {kind}", "relative error"
        views = [View.at(angle) for angle in ANGLES]
        light = [lights(view.mirrored)[kind] for view in views]
        given = [(view, light, case) for view, light in zip(views, light, strict=True) for case in CASES]

        def estimate(count: int, seed: int, given=given) -> np.ndarray:
            numbered = enumerate(given, len(given) * seed)
            return np.array([monte_carlo(lit, v.mirrored, v, *case, count, i) for i, (v, lit, case) in numbered])

        exact, own = estimate(truth, 100_000).T
        uncertainty = rms(own / exact)
        ours = np.concatenate([shaded(lit, v, CASES).numpy() for v, lit in zip(views, light, strict=True)])
        many = (CASES * (pixels_timed // len(CASES) + 1))[:pixels_timed]
        features, camera = pixels(views[1], many)
        lit, alpha = environment(light[1]), torch.ones(1, len(many))
        _, spent = timed(shade, features, alpha, lit, camera, torch.zeros(3))
        yield Row(name, "this program", "split sum", rms(ours / exact - 1), unit, spent, True, uncertainty)
        for count in samples:
            seeds = range(min(max(tries // count, 8), 100))
            errors = [estimate(count, seed)[:, 0] / exact - 1 for seed in seeds]
            view, lit, (roughness, material) = given[len(CASES)]
            drawn = lit, view.mirrored, view, roughness, material, count * pixels_timed
            _, spent = timed(monte_carlo, *drawn, seconds=0)
            yield Row(name, "Monte Carlo", count, rms(np.array(errors)), unit, spent, False, uncertainty)
