"""Build a mirror among dielectrics at night: a chrome egg, a glazed block and a clay ring on a wooden board. The egg mirrors darkness."""

import numpy as np

from benchmarks.scenes.solids import box, disc, ellipsoid, placed, ring, sculpt
from scripts.demo.shapes import Material, Scene, join, mix, moved, step


def wood(points: np.ndarray) -> np.ndarray:
    """Compute base colours of the board: brown, with darker rings of growth."""
    rings = np.sin(
        22 * np.hypot(points[:, 0] - 1.6, 0.4 * points[:, 1] + 3 * points[:, 2]) + 2 * np.sin(3 * points[:, 1])
    )
    return mix((0.36, 0.20, 0.09), (0.22, 0.11, 0.045), step(-0.6, 0.9, rings))


CHROME, GLAZE, CLAY, WOOD = range(4)
MATERIALS = (
    Material((0.86, 0.87, 0.88), metallic=1.0, roughness=0.04),
    Material((0.05, 0.20, 0.42), metallic=0.0, roughness=0.08),
    Material((0.55, 0.27, 0.16), metallic=0.0, roughness=0.85),
    Material(wood, metallic=0.0, roughness=0.55),
)


def build() -> Scene:
    """Build the board, 2 units wide, and what stands on it."""
    axes = [[0.9, 0.436, 0], [-0.436, 0.9, 0], [0, 0, 1]]
    block = placed(box((0, 0, 0), (0.24, 0.17, 0.26), 0.06), (-0.42, 0.22, -0.19), axes)
    mesh = join(
        sculpt(disc((0, 0, -0.50), (0, 0, 1), 0.98, 0.05, 0.03), (-1, -1, -0.56), (1, 1, -0.44), 0.011, WOOD),
        sculpt(ellipsoid((0.30, 0.28, -0.02), (0.33, 0.33, 0.43)), (-0.1, -0.1, -0.5), (0.7, 0.7, 0.5), 0.009, CHROME),
        sculpt(block, (-0.8, -0.2, -0.5), (0, 0.6, 0.2), 0.009, GLAZE),
        sculpt(ring((-0.05, -0.50, -0.35), (0, 0, 1), 0.26, 0.10), (-0.5, -0.9, -0.5), (0.4, -0.1, -0.2), 0.009, CLAY),
    )
    return Scene(moved(mesh, (0, 0, 0.07)), MATERIALS, light="night", lowest=0.0)
