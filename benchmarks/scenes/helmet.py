"""Build a pilot's helmet: rough striped plastic, a gold visor, a steel frame, copper at the ears, rubber below."""

import numpy as np

from benchmarks.scenes.solids import Solid, blend, carve, disc, ellipsoid, mirrored, ring, sculpt, sweep
from scripts.demo.shapes import Material, Scene, join, mix, step


def stripes(points: np.ndarray) -> np.ndarray:
    """Compute base colours of the shell: off-white, with a red stripe from front to back between two blue stripes."""
    across = np.abs(points[:, 1])
    red, blue = 1 - step(0.085, 0.10, across), step(0.13, 0.145, across) * (1 - step(0.175, 0.19, across))
    return mix((0.70, 0.68, 0.62), (0.50, 0.04, 0.03), red) + blue[:, None] * (np.array([0.03, 0.09, 0.35]) - 0.66)


SHELL, GOLD, STEEL, COPPER, RUBBER = range(5)
MATERIALS = (
    Material(stripes, metallic=0.0, roughness=0.50),
    Material((0.944, 0.720, 0.330), metallic=1.0, roughness=0.05),
    Material((0.62, 0.61, 0.60), metallic=1.0, roughness=0.28),
    Material((0.920, 0.480, 0.330), metallic=1.0, roughness=0.15),
    Material((0.025, 0.025, 0.028), metallic=0.0, roughness=0.65),
)


def build() -> Scene:
    """Build the helmet looking along +x, 1.5 units high."""
    skull = ellipsoid((-0.02, 0, 0.12), (0.76, 0.67, 0.66))
    opening = ellipsoid((0.80, 0, 0.13), (0.55, 0.54, 0.37))
    ears = mirrored(
        blend(
            0.03,
            disc((-0.10, 0.66, 0.05), (0, 1, 0), 0.20, 0.06, 0.025),
            ellipsoid((-0.10, 0.72, 0.05), (0.09, 0.05, 0.09)),
        )
    )
    low = np.array([-0.85, -0.8, -0.8])
    mesh = join(
        sculpt(carve(0.03, skull, opening), low, (0.85, 0.8, 0.85), 0.0105, SHELL),
        sculpt(ellipsoid((0.0, 0, 0.12), (0.68, 0.60, 0.58)), low, -low, 0.012, GOLD),
        sculpt(_frame(skull, opening, 0.04), low, (0.9, 0.8, 0.85), 0.009, STEEL),
        sculpt(ears, low, (0.85, 0.85, 0.85), 0.009, COPPER),
        sculpt(ring((-0.02, 0, -0.50), (0, 0, 1), 0.45, 0.13), low, -low, 0.012, RUBBER),
        sculpt(ring((-0.02, 0, -0.66), (0, 0, 1), 0.50, 0.075), low, -low, 0.010, STEEL),
        sculpt(
            sweep([(-0.22, 0.70, 0.10), (-0.27, 0.74, 0.45), (-0.31, 0.76, 0.80)], [0.03, 0.018, 0.022]),
            (-0.4, 0.6, 0), (-0.15, 0.85, 0.85), 0.006, RUBBER,
        ),
    )  # fmt: skip
    return Scene(mesh, MATERIALS, light="sunrise")


def _frame(one: Solid, other: Solid, thickness: float) -> Solid:
    """Make a tube along the curve where the surfaces of two solids meet."""
    return lambda points: np.hypot(one(points), other(points)) - thickness
