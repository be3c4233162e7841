"""Build a teapot of glossy ceramic: a smooth body with spout, handle and lid, and two glazes that run into each other."""

import numpy as np

from benchmarks.scenes.solids import blend, carve, disc, ellipsoid, ring, sculpt, sweep
from scripts.demo.shapes import Material, Scene, join, mix, step


def glaze(points: np.ndarray) -> np.ndarray:
    """Compute base colours of the glaze: blue-green from above, running down over cream in uneven drops."""
    angle = np.arctan2(points[:, 1], points[:, 0])
    edge = -0.12 + 0.07 * np.sin(5 * angle + 0.7) + 0.05 * np.sin(8 * angle) + 0.03 * np.sin(19 * angle)
    over = step(-0.025, 0.025, points[:, 2] - edge)
    cream = mix((0.46, 0.33, 0.19), (0.62, 0.52, 0.36), step(-0.6, -0.2, points[:, 2]))
    blue = mix((0.015, 0.13, 0.20), (0.02, 0.24, 0.22), step(0, 0.55, points[:, 2]))
    return cream + over[:, None] * (blue - cream)


MATERIALS = (
    Material(glaze, metallic=0.0, roughness=0.08),
    Material((0.015, 0.13, 0.20), metallic=0.0, roughness=0.08),
)


def build() -> Scene:
    """Build the teapot, 2.2 units from the handle to the spout."""
    spout = sweep([(0.40, 0, -0.24), (0.74, 0, -0.14), (0.90, 0, 0.12), (1.06, 0, 0.33)], [0.19, 0.125, 0.085, 0.08])
    mouth = sweep([(0.93, 0, 0.16), (1.06, 0, 0.33), (1.20, 0, 0.50)], [0.03, 0.048, 0.06])
    handle = [(-0.42, 0, 0.24), (-0.80, 0, 0.36), (-1.03, 0, 0.10), (-0.88, 0, -0.22), (-0.45, 0, -0.34)]
    body = blend(
        0.14,
        ellipsoid((0, 0, -0.08), (0.64, 0.64, 0.48)),
        spout,
        sweep(handle, [0.085, 0.07, 0.065, 0.06, 0.08]),
        disc((0, 0, -0.54), (0, 0, 1), 0.38, 0.06, 0.03),
    )
    body = carve(0.03, blend(0.06, body, ring((0, 0, 0.32), (0, 0, 1), 0.36, 0.03)), mouth)
    lid = blend(
        0.12,
        ellipsoid((0, 0, 0.31), (0.355, 0.355, 0.15)),
        ellipsoid((0, 0, 0.53), (0.10, 0.10, 0.085)),
    )
    mesh = join(
        sculpt(body, (-1.15, -0.7, -0.65), (1.2, 0.7, 0.5), 0.011, 0),
        sculpt(lid, (-0.4, -0.4, 0.1), (0.4, 0.4, 0.65), 0.009, 1),
    )
    return Scene(mesh, MATERIALS, light="interior")
