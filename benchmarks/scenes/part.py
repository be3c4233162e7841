"""Build a money-pig of painted clay, all of it matte but for a small chrome bell at its neck."""

import numpy as np

from benchmarks.scenes.solids import blend, carve, disc, ellipsoid, mirrored, ring, sculpt, sweep
from scripts.demo.shapes import Material, Scene, join, mix, step


def clay(points: np.ndarray) -> np.ndarray:
    """Compute base colours of the pig: pink clay with white flowers and darker feet."""
    spots = np.array(
        [(-0.35, 0.45, 0.25), (0.10, 0.50, 0.10), (-0.65, 0.30, -0.05), (-0.2, 0.0, 0.62), (0.25, 0.2, 0.5)]
    )
    spots = np.concatenate([spots, spots * [1, -1, 1] + [0.08, 0, -0.06]])
    apart = points[:, None] - spots
    near = np.linalg.norm(apart, axis=2)
    nearest = near.argmin(axis=1)
    away, way = near.min(axis=1), np.take_along_axis(apart, nearest[:, None, None], axis=1)[:, 0]
    petals = 0.075 + 0.03 * np.cos(5 * np.arctan2(way[:, 2], way[:, 0] + 0.3 * way[:, 1]))
    colour = mix((0.58, 0.26, 0.22), (0.74, 0.70, 0.62), step(0.012, -0.012, away - petals - 0.05))
    colour = mix(colour, (0.65, 0.42, 0.06), step(0.012, -0.012, away - 0.06))
    return mix(colour, (0.20, 0.07, 0.05), step(-0.49, -0.53, points[:, 2]))


CLAY, COLLAR, EYE, CHROME = range(4)
MATERIALS = (
    Material(clay, metallic=0.0, roughness=0.9),
    Material((0.10, 0.16, 0.40), metallic=0.0, roughness=0.95),
    Material((0.02, 0.02, 0.02), metallic=0.0, roughness=0.8),
    Material((0.86, 0.87, 0.88), metallic=1.0, roughness=0.06),
)


def build() -> Scene:
    """Build the pig along +x, two units long."""
    legs = [mirrored(sweep([(x, 0.26, -0.2), (x, 0.28, -0.60)], [0.17, 0.14])) for x in (-0.50, 0.26)]
    ears = mirrored(sweep([(0.50, 0.22, 0.42), (0.52, 0.34, 0.58), (0.62, 0.40, 0.60)], [0.10, 0.09, 0.03]))
    head, snout = ellipsoid((0.52, 0, 0.18), (0.36, 0.35, 0.35)), disc((0.88, 0, 0.10), (1, 0, 0.1), 0.15, 0.10, 0.04)
    tail = sweep(
        [(-0.80, 0, 0.1), (-0.92, 0.04, 0.18), (-0.98, -0.03, 0.26), (-0.94, 0.0, 0.36)], [0.06, 0.045, 0.04, 0.03]
    )
    pig = blend(0.10, ellipsoid((-0.16, 0, 0.0), (0.72, 0.52, 0.50)), head, snout, ears, tail, *legs)
    nostrils = mirrored(ellipsoid((1.0, 0.055, 0.11), (0.06, 0.03, 0.04)))
    slot = ellipsoid((-0.2, 0, 0.52), (0.16, 0.025, 0.09))
    low, high = np.array([-1.1, -0.6, -0.85]), np.array([1.05, 0.6, 0.75])
    mesh = join(
        sculpt(carve(0.02, pig, nostrils, slot), low, high, 0.0115, CLAY),
        sculpt(ring((0.30, 0, 0.06), (0.93, 0, 0.37), 0.44, 0.05), low, high, 0.010, COLLAR),
        sculpt(mirrored(ellipsoid((0.77, 0.17, 0.33), (0.05, 0.05, 0.05))), low, high, 0.008, EYE),
        sculpt(ellipsoid((0.56, 0, -0.40), (0.135, 0.135, 0.135)), low, high, 0.008, CHROME),
    )
    return Scene(mesh, MATERIALS, light="courtyard")
