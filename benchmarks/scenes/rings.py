"""Build three linked metal rings. They reflect and occlude each other, which makes this scene hard."""

import numpy as np

from scripts.demo.shapes import Material, Scene, join, tube

MATERIALS = (
    Material((0.944, 0.720, 0.330), 1.0, 0.10),
    Material((0.930, 0.920, 0.900), 1.0, 0.10),
    Material((0.920, 0.480, 0.330), 1.0, 0.25),
)


def build() -> Scene:
    """Build rings of radius 0.65 and thickness 0.2 in three planes at right angles, each linked with both others."""
    angle = np.arange(96) * (2 * np.pi / 96)
    ring = np.stack([0.65 * np.cos(angle), 0.65 * np.sin(angle), np.zeros(96)], -1) - [0.35, 0, 0]
    rings = [
        tube(np.roll(ring, turn, axis=1) + 0.175, 0.1, turn, closed=True, rows=256, columns=64) for turn in range(3)
    ]
    return Scene(join(*rings), MATERIALS, light="courtyard", lowest=-0.9)
