"""Build a flowering cactus in a clay pot. All of it is matte: the scene has no reflections."""

import numpy as np

from benchmarks.scenes.solids import sculpt, sweep
from scripts.demo.shapes import Material, Mesh, Scene, join, lathe, mix, moved, step


def clay(points: np.ndarray) -> np.ndarray:
    """Compute base colours of terracotta with a band of triangles."""
    angle, z = np.arctan2(points[:, 1], points[:, 0]), points[:, 2]
    wave = np.abs((angle * 8 / np.pi) % 2 - 1)  # a zigzag, 16 a turn
    band = step(0.0, 0.02, z + 0.72 - 0.17 * wave) * (1 - step(0.0, 0.02, z + 0.50))
    return mix((0.48, 0.17, 0.08), (0.70, 0.60, 0.44), band)


def green(points: np.ndarray) -> np.ndarray:
    """Compute base colours of the cactus: darker below, lighter towards the tops."""
    return mix((0.05, 0.15, 0.06), (0.14, 0.32, 0.10), step(-0.4, 0.9, points[:, 2]))


POT, SOIL, PLANT, FLOWER, SAUCER = range(5)
MATERIALS = (
    Material(clay, metallic=0.0, roughness=0.9),
    Material((0.06, 0.035, 0.02), metallic=0.0, roughness=1.0),
    Material(green, metallic=0.0, roughness=0.9),
    Material((0.65, 0.10, 0.22), metallic=0.0, roughness=0.9),
    Material((0.06, 0.13, 0.30), metallic=0.0, roughness=0.9),
)
WALL = [(0.0, -0.93), (0.30, -0.93), (0.32, -0.91), (0.44, -0.45), (0.45, -0.43), (0.50, -0.42), (0.515, -0.40)]
RIM = [(0.525, -0.28), (0.51, -0.26), (0.45, -0.26), (0.435, -0.28), (0.42, -0.37)]
GROUND = [(0.40, -0.38), (0.25, -0.365), (0.0, -0.35)]
DISH = [
    (0.0, -1.0),
    (0.36, -1.0),
    (0.40, -0.98),
    (0.50, -0.88),
    (0.50, -0.865),
    (0.485, -0.865),
    (0.40, -0.94),
    (0.0, -0.95),
]
STEM = [(0.0, -0.45), (0.15, -0.44), (0.20, -0.35), (0.24, 0.0), (0.24, 0.45), (0.20, 0.68), (0.12, 0.80), (0.0, 0.83)]


def build() -> Scene:
    """Build the plant, two units high from the saucer to the flower."""
    arms = (
        sweep([(0, 0.12, 0.0), (0.02, 0.40, 0.02), (0.04, 0.52, 0.20), (0.05, 0.53, 0.48)], [0.09, 0.10, 0.115, 0.09]),
        sweep([(0, -0.12, 0.22), (0, -0.36, 0.24), (0, -0.47, 0.40), (0, -0.48, 0.62)], [0.08, 0.085, 0.10, 0.08]),
    )
    mesh = join(
        lathe([(POT, WALL + RIM), (SOIL, GROUND)], rows=300, columns=480),
        lathe([(SAUCER, DISH)], rows=160, columns=240),
        lathe([(PLANT, STEM)], rows=220, columns=336, flutes=lambda angle, z: 1 + 0.09 * np.cos(12 * angle)),
        sculpt(arms[0], (-0.15, 0, -0.15), (0.2, 0.7, 0.65), 0.01, PLANT),
        sculpt(arms[1], (-0.15, -0.65, 0.1), (0.15, 0, 0.75), 0.01, PLANT),
        moved(_flower(), (0.0, 0.0, 0.82)),
        moved(_flower(), (0.05, 0.53, 0.55)),
        moved(_flower(), (0.0, -0.48, 0.68)),
    )
    return Scene(mesh, MATERIALS, light="courtyard")


def _flower() -> Mesh:
    """Make a flower of eight petals around a hollow."""
    bell = [
        (0.0, 0.0),
        (0.06, 0.01),
        (0.10, 0.07),
        (0.15, 0.14),
        (0.14, 0.145),
        (0.09, 0.085),
        (0.05, 0.04),
        (0.0, 0.03),
    ]
    return lathe([(FLOWER, bell)], rows=100, columns=128, flutes=lambda angle, z: 1 + 1.5 * z * np.cos(8 * angle))
