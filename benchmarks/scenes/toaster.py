"""Build a toaster on a tray, all of polished steel, with two slices of bread. Its flat and concave mirrors reflect each other."""

import numpy as np

from benchmarks.scenes.solids import box, carve, disc, ellipsoid, sculpt, sweep
from scripts.demo.shapes import Material, Mesh, Scene, join, mix, moved, step

STEEL, TRAY, PLASTIC, BRASS, TOAST = range(5)
SLICE = (0.36, 0.05, 0.25)  # half a slice


def toast(points: np.ndarray) -> np.ndarray:
    """Compute base colours of toast: golden in the middle, brown towards the crust, with darker vertical stripes."""
    x, z = points[:, 0] / SLICE[0], (points[:, 2] - 0.36) / SLICE[2]
    crust = step(0.55, 1.0, np.maximum(np.abs(x), np.abs(z)))
    grid = 0.5 + 0.5 * np.cos(7 * np.pi * x)
    return mix(mix((0.72, 0.42, 0.15), (0.42, 0.18, 0.05), 0.7 * grid), (0.16, 0.05, 0.015), crust)


MATERIALS = (
    Material((0.90, 0.90, 0.91), metallic=1.0, roughness=0.05),
    Material((0.80, 0.78, 0.76), metallic=1.0, roughness=0.10),
    Material((0.03, 0.03, 0.035), metallic=0.0, roughness=0.35),
    Material((0.90, 0.72, 0.38), metallic=1.0, roughness=0.20),
    Material(toast, metallic=0.0, roughness=0.85),
)


def build() -> Scene:
    """Build a toaster 1.24 long, 0.68 wide and 0.8 high.

    Both long sides are concave mirrors of radius 0.9. The tray's rim is a concave mirror of radius 0.2.
    """
    body = carve(
        0.04,
        box((0, 0, -0.08), (0.62, 0.34, 0.40), 0.09),
        *(box((0, side * 0.125, 0.30), (0.45, 0.07, 0.40), 0.03) for side in (1, -1)),
        *(ellipsoid((0, side * 1.17, -0.08), (0.9, 0.9, 0.9)) for side in (1, -1)),
    )
    tray = carve(0.02, box((0, 0, -0.48), (0.98, 0.70, 0.13), 0.06), box((0, 0, -0.24), (0.93, 0.65, 0.30), 0.20))
    foot = sculpt(disc((0, 0, -0.50), (0, 0, 1), 0.06, 0.06, 0.02), (-0.1, -0.1, -0.6), (0.1, 0.1, -0.4), 0.01, PLASTIC)
    lever = sweep([(0.58, 0, 0.10), (0.70, 0, 0.11), (0.78, 0, 0.11)], [0.03, 0.035, 0.06])
    dial = disc((0.63, 0, -0.22), (1, 0, 0), 0.09, 0.04, 0.02)
    mesh = join(
        sculpt(body, (-0.65, -0.36, -0.5), (0.65, 0.36, 0.35), 0.0105, STEEL),
        sculpt(tray, (-1, -0.72, -0.63), (1, 0.72, -0.33), 0.011, TRAY),
        *(moved(foot, (x, y, 0)) for x in (0.45, -0.45) for y in (0.22, -0.22)),
        sculpt(lever, (0.5, -0.1, 0), (0.9, 0.1, 0.2), 0.008, PLASTIC),
        sculpt(dial, (0.57, -0.12, -0.34), (0.7, 0.12, -0.1), 0.008, BRASS),
        *(_slice(side * 0.125) for side in (1, -1)),
    )
    return Scene(mesh, MATERIALS, light="courtyard", lowest=0.0)


def _slice(y: float) -> Mesh:
    low, high = np.array([-0.4, y - 0.07, 0.1]), np.array([0.4, y + 0.07, 0.65])
    return sculpt(box((0, y, 0.36), SLICE, 0.045), low, high, 0.0095, TOAST)
