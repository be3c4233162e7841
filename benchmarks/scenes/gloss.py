"""Build a toy of painted plastic rings in soft light. Its highlights are as sharp as a polished metal's, but none of it is metal."""

import numpy as np

from benchmarks.scenes.lights import museum
from benchmarks.scenes.solids import disc, ellipsoid, ring, sculpt
from scripts.demo.shapes import Material, Mesh, Scene, join

YELLOW, BLUE, RED, BLACK = range(4)
MATERIALS = (
    Material((0.70, 0.40, 0.03), metallic=0.0, roughness=0.05),
    Material((0.03, 0.10, 0.42), metallic=0.0, roughness=0.05),
    Material((0.50, 0.03, 0.02), metallic=0.0, roughness=0.05),
    Material((0.020, 0.020, 0.022), metallic=0.0, roughness=0.05),
)
RINGS = (
    (BLUE, -0.56, 0.56, 0.21),
    (YELLOW, -0.19, 0.46, 0.19),
    (RED, 0.14, 0.37, 0.17),
    (BLUE, 0.43, 0.29, 0.145),
)
"""Material, height, radius and thickness of each ring."""


def build() -> Scene:
    """Build the rings on a black foot, under a yellow ball, 2 units high."""
    foot = disc((0, 0, -0.87), (0, 0, 1), 0.78, 0.09, 0.06)
    mesh = join(
        sculpt(foot, (-0.8, -0.8, -1), (0.8, 0.8, -0.7), 0.011, BLACK),
        *(_ring(*each) for each in RINGS),
        sculpt(ellipsoid((0, 0, 0.74), (0.24, 0.24, 0.24)), (-0.3, -0.3, 0.4), (0.3, 0.3, 1.0), 0.009, YELLOW),
    )
    return Scene(mesh, MATERIALS, light=museum())


def _ring(material: int, height: float, radius: float, thickness: float) -> Mesh:
    centre = np.array([0, 0, height])
    half = np.array([radius + thickness, radius + thickness, thickness])
    return sculpt(ring(centre, (0, 0, 1), radius, thickness), centre - half, centre + half, 0.010, material)
