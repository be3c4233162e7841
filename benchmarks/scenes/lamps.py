"""Build a chrome jug beside a pot with a black glaze, in a cellar with lamps. Their mirror images are equally sharp."""

from benchmarks.scenes.lights import cellar
from benchmarks.scenes.solids import disc, sculpt, sweep
from benchmarks.scenes.textures import clouds
from scripts.demo.shapes import Material, Scene, join, lathe, mix, moved, step


def stone(points):
    """Compute base colours of the stone: grey, with darker veins."""
    return mix((0.46, 0.44, 0.40), (0.30, 0.285, 0.26), step(-0.6, 1.2, clouds(points, 0.25, seed=21)))


CHROME, GLAZE, STONE = range(3)
MATERIALS = (
    Material((0.86, 0.87, 0.88), metallic=1.0, roughness=0.06),
    Material((0.030, 0.028, 0.026), metallic=0.0, roughness=0.06),
    Material(stone, metallic=0.0, roughness=0.75),
)
JUG = [(0.0, 0.0), (0.21, 0.0), (0.225, 0.015), (0.22, 0.04), (0.29, 0.22), (0.30, 0.40), (0.22, 0.62), (0.155, 0.80)]
MOUTH = [(0.155, 0.90), (0.185, 1.00), (0.175, 1.01), (0.14, 0.90), (0.135, 0.80), (0.0, 0.74)]
POT = [(0.0, 0.0), (0.19, 0.0), (0.205, 0.015), (0.21, 0.05), (0.33, 0.20), (0.38, 0.38), (0.34, 0.55), (0.22, 0.66)]
LID = [(0.19, 0.68), (0.20, 0.70), (0.15, 0.74), (0.06, 0.77), (0.04, 0.80), (0.07, 0.85), (0.05, 0.89), (0.0, 0.90)]


def build() -> Scene:
    """Build the jug with its handle and the pot on the stone, 1.9 units wide."""
    handle = sweep([(-0.20, 0, 0.62), (-0.36, 0, 0.60), (-0.42, 0, 0.40), (-0.27, 0, 0.22)], [0.04, 0.035, 0.035, 0.04])
    slab = disc((0, 0, -0.55), (0, 0, 1), 0.94, 0.06, 0.03)
    mesh = join(
        moved(lathe([(CHROME, JUG + MOUTH)], rows=420, columns=320), (-0.42, 0.10, -0.49)),
        moved(sculpt(handle, (-0.5, -0.1, 0.1), (-0.1, 0.1, 0.7), 0.008, CHROME), (-0.42, 0.10, -0.49)),
        moved(lathe([(GLAZE, POT + LID)], rows=420, columns=320), (0.44, -0.08, -0.49)),
        sculpt(slab, (-1, -1, -0.62), (1, 1, -0.48), 0.011, STONE),
    )
    return Scene(moved(mesh, (0, 0, 0.05)), MATERIALS, light=cellar(), lowest=0.0)
