"""Build two vases of one colour side by side: one of polished copper, one glazed like it. They mirror each other."""

from benchmarks.scenes.solids import disc, sculpt
from scripts.demo.shapes import Material, Scene, join, lathe, moved

COPPER, GLAZE, SLATE = range(3)
MATERIALS = (
    Material((0.926, 0.520, 0.380), metallic=1.0, roughness=0.18),
    Material((0.640, 0.270, 0.160), metallic=0.0, roughness=0.12),
    Material((0.07, 0.075, 0.08), metallic=0.0, roughness=0.65),
)
FOOT = [(0.0, -0.66), (0.19, -0.66), (0.20, -0.645), (0.18, -0.60), (0.15, -0.56)]
BODY = [
    (0.24, -0.44),
    (0.35, -0.22),
    (0.36, 0.0),
    (0.27, 0.24),
    (0.155, 0.42),
    (0.135, 0.54),
    (0.175, 0.68),
    (0.20, 0.72),
]
HOLLOW = [(0.19, 0.73), (0.155, 0.68), (0.115, 0.54), (0.135, 0.42), (0.12, 0.36), (0.0, 0.33)]


def build() -> Scene:
    """Build the vases, 1.4 units high, on a slate."""
    vases = [lathe([(which, FOOT + BODY + HOLLOW)], rows=420, columns=320) for which in (COPPER, GLAZE)]
    slate = sculpt(disc((0, 0, -0.71), (0, 0, 1), 0.92, 0.05, 0.02), (-1, -1, -0.8), (1, 1, -0.6), 0.011, SLATE)
    mesh = join(*(moved(vase, (x, 0.05 * x, 0)) for vase, x in zip(vases, (-0.43, 0.43), strict=True)), slate)
    return Scene(mesh, MATERIALS, light="forest", lowest=0.0)
