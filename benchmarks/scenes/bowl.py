"""Build a bowl of polished brass that mirrors the fruit in it, and itself."""

import numpy as np

from benchmarks.scenes.solids import blend, ellipsoid, sculpt
from benchmarks.scenes.textures import clouds
from scripts.demo.shapes import Material, Scene, join, lathe, mix, moved, step


def peel(points: np.ndarray) -> np.ndarray:
    """Compute base colours of a pear: green-yellow, reddish on one side, with spots."""
    red = step(-0.2, 0.5, points[:, 0] + 0.4 * clouds(points, 0.3, seed=11))
    return mix(
        mix((0.42, 0.45, 0.08), (0.50, 0.16, 0.05), red),
        (0.16, 0.12, 0.03),
        step(0.9, 1.6, clouds(points, 0.05, seed=12)),
    )


BRASS, LEMON, PLUM, PEAR = range(4)
MATERIALS = (
    Material((0.90, 0.72, 0.40), metallic=1.0, roughness=0.10),
    Material((0.72, 0.50, 0.03), metallic=0.0, roughness=0.35),
    Material((0.10, 0.02, 0.06), metallic=0.0, roughness=0.20),
    Material(peel, metallic=0.0, roughness=0.45),
)
OUTSIDE = [
    (0.0, -0.52),
    (0.32, -0.52),
    (0.34, -0.50),
    (0.33, -0.47),
    (0.52, -0.38),
    (0.76, -0.16),
    (0.90, 0.10),
    (0.96, 0.30),
]
INSIDE = [(0.955, 0.315), (0.93, 0.30), (0.87, 0.10), (0.73, -0.13), (0.50, -0.33), (0.25, -0.43), (0.0, -0.45)]


def build() -> Scene:
    """Build the bowl, 1.9 units wide, with a lemon, a plum and a pear."""
    low, high = np.array([-0.7, -0.7, -0.5]), np.array([0.7, 0.7, 0.6])
    lemon = blend(
        0.1, ellipsoid((-0.32, 0.10, -0.10), (0.28, 0.21, 0.21)), ellipsoid((-0.59, 0.10, -0.10), (0.07, 0.06, 0.06))
    )
    pear = blend(
        0.2, ellipsoid((0.26, 0.22, -0.10), (0.25, 0.25, 0.24)), ellipsoid((0.26, 0.26, 0.20), (0.12, 0.12, 0.16))
    )
    mesh = join(
        lathe([(BRASS, OUTSIDE + INSIDE)], rows=420, columns=640),
        sculpt(lemon, low, high, 0.009, LEMON),
        sculpt(ellipsoid((0.06, -0.34, -0.13), (0.22, 0.21, 0.20)), low, high, 0.009, PLUM),
        sculpt(pear, low, high, 0.009, PEAR),
    )
    return Scene(moved(mesh, (0, 0, 0.07)), MATERIALS, light="interior", lowest=0.15)
