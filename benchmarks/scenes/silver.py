"""Build a jug of polished silver in a white studio. Nearly all that it mirrors is white, as white paint would be."""

import numpy as np

from benchmarks.scenes.lights import white_studio
from benchmarks.scenes.solids import sculpt, sweep
from scripts.demo.shapes import Material, Scene, join, lathe, moved, tube

SILVER, GRIP = range(2)
MATERIALS = (
    Material((0.960, 0.950, 0.915), metallic=1.0, roughness=0.08),
    Material((0.025, 0.020, 0.018), metallic=0.0, roughness=0.30),
)
FOOT = [(0.0, -0.98), (0.34, -0.98), (0.36, -0.96), (0.33, -0.93), (0.20, -0.88), (0.16, -0.82)]
BODY = [
    (0.22, -0.76),
    (0.46, -0.60),
    (0.58, -0.34),
    (0.55, -0.06),
    (0.40, 0.22),
    (0.27, 0.42),
    (0.245, 0.56),
    (0.29, 0.74),
]
LID = [(0.31, 0.76), (0.30, 0.79), (0.22, 0.86), (0.08, 0.91), (0.04, 0.93), (0.035, 0.95)]
KNOB = [(0.075, 0.985), (0.08, 1.02), (0.055, 1.06), (0.0, 1.08)]


def build() -> Scene:
    """Build the jug, 2 units high, with a dark grip and a spout."""
    angle = np.linspace(-0.45 * np.pi, 0.45 * np.pi, 24)
    grip = np.stack([0.36 + 0.36 * np.cos(angle), 0 * angle, 0.06 + 0.50 * np.sin(angle)], axis=1)
    spout = sweep([(-0.40, 0, -0.42), (-0.60, 0, -0.22), (-0.72, 0, 0.12), (-0.80, 0, 0.40)], [0.15, 0.11, 0.08, 0.06])
    mesh = join(
        lathe([(SILVER, FOOT + BODY + LID + KNOB)], rows=520, columns=480),
        tube(grip, 0.055, GRIP, closed=False),
        sculpt(spout, (-1, -0.2, -0.6), (-0.2, 0.2, 0.5), 0.008, SILVER),
    )
    return Scene(moved(mesh, (0.03, 0, -0.05)), MATERIALS, light=white_studio(), lowest=-0.2)
