"""Build a glazed plate with objects of several materials on it. Plate and objects reflect each other."""

import numpy as np

from benchmarks.scenes.solids import box, placed, ring, sculpt
from scripts.demo.shapes import Material, Scene, join, lathe, mix, moved, step


def glaze(points: np.ndarray) -> np.ndarray:
    """Compute base colours of the plate: white, with a blue line inside a wreath of leaves on the rim."""
    radius, angle = np.hypot(points[:, 0], points[:, 1]), np.arctan2(points[:, 1], points[:, 0])
    line = 1 - step(0.010, 0.020, np.abs(radius - 0.66))
    leaf = 1 - step(-0.008, 0.008, np.abs(radius - 0.83) - 0.07 * np.abs(np.sin(12 * angle)) ** 0.7)
    return mix((0.78, 0.76, 0.70), (0.02, 0.06, 0.30), np.maximum(line, leaf))


def skin(points: np.ndarray) -> np.ndarray:
    """Compute base colours of an apple: red, yellow about the stalk, with fine streaks."""
    x, y = points[:, 0] + 0.36, points[:, 1] - 0.28
    angle, radius = np.arctan2(y, x), np.hypot(x, y)
    streaks = 0.5 + 0.25 * np.sin(17 * angle) + 0.25 * np.sin(29 * angle + 1)
    return mix((0.62, 0.40, 0.08), (0.42, 0.03, 0.02), step(0.02, 0.22, radius - 0.10 * streaks))


PLATE, STEEL, APPLE, COPPER, GOLD, CLAY, STALK = range(7)
MATERIALS = (
    Material(glaze, metallic=0.0, roughness=0.12),
    Material((0.90, 0.90, 0.91), metallic=1.0, roughness=0.04),
    Material(skin, metallic=0.0, roughness=0.25),
    Material((0.920, 0.480, 0.330), metallic=1.0, roughness=0.25),
    Material((0.944, 0.720, 0.330), metallic=1.0, roughness=0.12),
    Material((0.16, 0.26, 0.20), metallic=0.0, roughness=0.80),
    Material((0.10, 0.05, 0.02), metallic=0.0, roughness=0.80),
)
UNDER = [(0.0, -0.40), (0.42, -0.40), (0.46, -0.42), (0.50, -0.42), (0.52, -0.40), (0.70, -0.36), (0.97, -0.265)]
OVER = [(0.99, -0.25), (0.97, -0.24), (0.72, -0.305), (0.62, -0.345), (0.55, -0.36), (0.0, -0.36)]
FRUIT = [(0.0, -0.19), (0.05, -0.205), (0.12, -0.20), (0.20, -0.14), (0.26, 0.0), (0.27, 0.07), (0.235, 0.16)]
DIMPLE = [(0.15, 0.205), (0.08, 0.195), (0.03, 0.155), (0.0, 0.145)]
GOBLET = [
    (0.0, 0.0),
    (0.15, 0.0),
    (0.165, 0.012),
    (0.15, 0.028),
    (0.06, 0.05),
    (0.03, 0.09),
    (0.03, 0.22),
    (0.05, 0.27),
]
CUP = [(0.14, 0.34), (0.18, 0.43), (0.19, 0.56), (0.185, 0.72), (0.175, 0.73), (0.165, 0.72), (0.165, 0.56)]
HOLLOW = [(0.15, 0.44), (0.11, 0.37), (0.0, 0.33)]


def build() -> Scene:
    """Build the plate and the objects on it. The plate is 2 units wide; the objects stand at z = -0.36."""
    ball = [(0.30 * abs(np.cos(a)), 0.30 * np.sin(a)) for a in np.linspace(-np.pi / 2, np.pi / 2, 65)]
    axes = [[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0, 1]]
    cube = placed(box((0, 0, 0), (0.15, 0.15, 0.15), 0.04), (-0.42, -0.32, -0.212), axes)
    mesh = join(
        lathe([(PLATE, UNDER + OVER)], rows=420, columns=720),
        moved(lathe([(STEEL, ball)], rows=160, columns=240), (0.30, 0.34, -0.062)),
        moved(lathe([(APPLE, FRUIT + DIMPLE)], rows=180, columns=360), (-0.36, 0.28, -0.158)),
        moved(
            lathe([(STALK, [(0, 0), (0.018, 0.0), (0.014, 0.06), (0.022, 0.15), (0, 0.152)])], 40, 24),
            (-0.36, 0.28, -0.02),
        ),
        moved(lathe([(GOLD, GOBLET + CUP + HOLLOW)], rows=320, columns=200), (-0.02, -0.06, -0.362)),
        sculpt(cube, (-0.7, -0.6, -0.4), (-0.15, -0.05, 0), 0.01, CLAY),
        sculpt(ring((0.34, -0.34, -0.292), (0, 0, 1), 0.17, 0.07), (0, -0.65, -0.4), (0.65, 0, -0.2), 0.008, COPPER),
    )
    return Scene(mesh, MATERIALS, light="interior", lowest=0.0)
