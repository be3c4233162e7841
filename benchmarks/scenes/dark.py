"""Build polished silver among dielectrics in a dark studio with a few lamps. Nearly all that the silver mirrors is black."""

import numpy as np

from benchmarks.scenes.night import wood
from benchmarks.scenes.solids import disc, ellipsoid, sculpt
from scripts.demo.shapes import Material, Scene, join, lathe, moved

SILVER, RED, CLAY, WOOD = range(4)
MATERIALS = (
    Material((0.960, 0.950, 0.915), metallic=1.0, roughness=0.05),
    Material((0.45, 0.025, 0.02), metallic=0.0, roughness=0.08),
    Material((0.55, 0.27, 0.16), metallic=0.0, roughness=0.85),
    Material(wood, metallic=0.0, roughness=0.55),
)
CUP = [(0.0, 0.0), (0.15, 0.0), (0.16, 0.012), (0.14, 0.03), (0.06, 0.06), (0.055, 0.09)]
SIDE = [(0.12, 0.13), (0.22, 0.22), (0.265, 0.36), (0.27, 0.52), (0.29, 0.63), (0.30, 0.65)]
HOLLOW = [(0.295, 0.655), (0.275, 0.63), (0.255, 0.52), (0.25, 0.36), (0.20, 0.24), (0.10, 0.17), (0.0, 0.15)]
CONE = [(0.0, 0.0), (0.27, 0.0), (0.285, 0.015), (0.275, 0.04), (0.16, 0.34), (0.05, 0.60), (0.03, 0.63), (0.0, 0.64)]


def build() -> Scene:
    """Build a wooden disc, 2 units wide, with a ball and a cup of silver, a ball of red plastic and a cone of clay on it."""
    red = ellipsoid((-0.46, -0.30, -0.19), (0.26, 0.26, 0.26))
    mesh = join(
        sculpt(disc((0, 0, -0.50), (0, 0, 1), 0.98, 0.05, 0.03), (-1, -1, -0.56), (1, 1, -0.44), 0.011, WOOD),
        moved(lathe([(SILVER, ball(0.36))], rows=320, columns=400), (0.40, 0.26, -0.09)),
        moved(lathe([(SILVER, CUP + SIDE + HOLLOW)], rows=320, columns=280), (-0.36, 0.42, -0.45)),
        sculpt(red, (-0.8, -0.6, -0.5), (-0.1, 0.0, 0.2), 0.009, RED),
        moved(lathe([(CLAY, CONE)], rows=160, columns=160), (0.22, -0.50, -0.45)),
    )
    return Scene(moved(mesh, (0, 0, 0.14)), MATERIALS, light="studio", lowest=0.0)


def ball(radius: float) -> list[tuple[float, float]]:
    """Return the profile of a ball about the origin."""
    return [(radius * abs(np.cos(a)), radius * np.sin(a)) for a in np.linspace(-np.pi / 2, np.pi / 2, 65)]
