"""Build a goblet of fluted silver with dark patches of tarnish, under an overcast sky."""

import numpy as np

from benchmarks.scenes.lights import overcast
from benchmarks.scenes.textures import clouds
from scripts.demo.shapes import Material, Scene, lathe, mix, step


def tarnish(points: np.ndarray) -> np.ndarray:
    """Compute how tarnished the surface is, from 0 to 1: in patches, and more so at the stem's mouldings and in the hollow."""
    narrow = step(0.30, 0.12, np.hypot(points[:, 0], points[:, 1])) * step(0.25, 0.0, np.abs(points[:, 2] + 0.35))
    spots = clouds(points, 0.6, seed=5) + 0.6 * clouds(points, 0.12, seed=6)
    return step(-0.1, 0.9, spots + 0.5 * narrow)


def colour(points: np.ndarray) -> np.ndarray:
    """Compute base colours: silver, yellow-brown under thin tarnish, dark under thick. Silver sulphide reflects about a tenth."""
    dark = tarnish(points)
    thin = mix((0.93, 0.92, 0.90), (0.50, 0.38, 0.24), step(0.0, 0.45, dark))
    thick = step(0.30, 1.0, dark)[:, None]
    return thin + thick * (np.array([0.085, 0.075, 0.075]) - thin)


MATERIALS = (Material(colour, metallic=1.0, roughness=lambda points: 0.14 + 0.30 * tarnish(points)),)
FOOT = [(0.0, -1.0), (0.40, -1.0), (0.43, -0.985), (0.42, -0.96), (0.30, -0.90), (0.15, -0.82), (0.085, -0.70)]
STEM = [(0.07, -0.55), (0.09, -0.47), (0.15, -0.43), (0.165, -0.38), (0.14, -0.33), (0.085, -0.30), (0.07, -0.22)]
BOWL = [(0.10, -0.13), (0.26, -0.06), (0.42, 0.06), (0.50, 0.22), (0.535, 0.45), (0.55, 0.75), (0.575, 0.985)]
HOLLOW = [
    (0.57, 1.0),
    (0.555, 0.985),
    (0.53, 0.75),
    (0.515, 0.45),
    (0.48, 0.23),
    (0.40, 0.09),
    (0.20, 0.0),
    (0.0, -0.02),
]


def build() -> Scene:
    """Build the goblet, two units high."""
    mesh = lathe([(0, FOOT + STEM + BOWL + HOLLOW)], rows=560, columns=480, flutes=_flutes)
    return Scene(mesh, MATERIALS, light=overcast(), lowest=0.0)


def _flutes(angle: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Make fourteen lobes of the bowl's lower half: return factors that scale the goblet's radius."""
    fade = step(-0.15, 0.0, z) * step(0.50, 0.35, z)
    return 1 + 0.025 * fade * np.cos(14 * angle)
