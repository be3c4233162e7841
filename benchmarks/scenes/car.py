"""Build a small round car of glossy patterned paint, dark glass, chrome and rubber."""

import numpy as np

from benchmarks.scenes.solids import Solid, blend, box, carve, disc, ellipsoid, mirrored, ring, sculpt, sweep
from scripts.demo.shapes import Material, Scene, join, mix, step


def paint(points: np.ndarray) -> np.ndarray:
    """Compute base colours of the paint: blue-green, with flames from the front wheels and two cream stripes from front to back."""
    x, y, z = points.T
    flame = 0.10 - 0.30 * np.abs(np.sin(9 * z + 0.6)) - 0.10 * np.sin(21 * z)
    flames = step(-0.02, 0.02, x - flame) * step(0.16, 0.20, np.abs(y))
    fire = mix((0.75, 0.40, 0.03), (0.55, 0.05, 0.02), step(0.0, 0.8, x))
    stripes = step(0.035, 0.05, np.abs(y)) * (1 - step(0.12, 0.135, np.abs(y)))
    color = mix((0.01, 0.09, 0.13), (0.70, 0.64, 0.48), stripes)
    return color + flames[:, None] * (fire - color)


PAINT, GLASS, CHROME, RUBBER, LAMP = range(5)
MATERIALS = (
    Material(paint, metallic=0.0, roughness=0.07),
    Material((0.012, 0.014, 0.018), metallic=0.0, roughness=0.03),
    Material((0.86, 0.87, 0.88), metallic=1.0, roughness=0.06),
    Material((0.022, 0.022, 0.024), metallic=0.0, roughness=0.70),
    Material((0.70, 0.68, 0.60), metallic=0.5, roughness=0.10),
)
WHEELS = (0.60, -0.58)


def build() -> Scene:
    """Build the car along +x, 2 units long."""
    cabin = ellipsoid((-0.10, 0, 0.06), (0.60, 0.36, 0.34))
    fenders = [mirrored(ellipsoid((x, 0.31, -0.10), (0.34, 0.15, 0.24))) for x in WHEELS]
    hull = blend(
        0.16, box((0, 0, -0.12), (0.93, 0.37, 0.17), 0.15), cabin, *fenders, ellipsoid((0.5, 0, 0), (0.42, 0.26, 0.14))
    )
    arches = [disc((x, 0, -0.25), (0, 1, 0), 0.235, 1.0, 0.01) for x in WHEELS]
    hubs = [
        mirrored(
            blend(
                0.02,
                disc((x, 0.38, -0.25), (0, 1, 0), 0.115, 0.035, 0.015),
                ellipsoid((x, 0.41, -0.25), (0.06, 0.035, 0.06)),
            )
        )
        for x in WHEELS
    ]
    tyres = [mirrored(ring((x, 0.36, -0.25), (0, 1, 0), 0.145, 0.07)) for x in WHEELS]
    axles = [disc((x, 0, -0.25), (0, 1, 0), 0.10, 0.36, 0.01) for x in WHEELS]
    bar = [(0.84, -0.42), (0.94, -0.26), (0.96, 0.0), (0.94, 0.26), (0.84, 0.42)]
    bumpers = [sweep([(side * x, y, -0.20) for x, y in bar], 0.035) for side in (1, -1)]
    low, high = np.array([-1.05, -0.55, -0.5]), np.array([1.05, 0.55, 0.5])
    mesh = join(
        sculpt(carve(0.03, hull, *arches), low, high, 0.0095, PAINT),
        sculpt(_windows(cabin), low, high, 0.0095, GLASS),
        *(sculpt(solid, low, high, 0.009, CHROME) for solid in (*hubs, *bumpers)),
        *(sculpt(solid, low, high, 0.011, RUBBER) for solid in (*tyres, *axles)),
        sculpt(mirrored(ellipsoid((0.86, 0.27, -0.02), (0.08, 0.08, 0.08))), low, high, 0.008, LAMP),
        sculpt(mirrored(ring((0.875, 0.27, -0.02), (1, 0.15, 0.1), 0.08, 0.014)), low, high, 0.006, CHROME),
    )
    return Scene(mesh, MATERIALS, light="forest", lowest=-0.1)


def _windows(cabin: Solid) -> Solid:
    """Make the glass panes on all four sides of the cabin. They stand out a little."""
    panes = (box((-0.10, 0, 0.235), (0.34, 0.6, 0.085), 0.06), box((-0.10, 0, 0.235), (0.8, 0.21, 0.085), 0.06))
    outside = [
        carve(0.03, lambda points: cabin(points) - 0.008, lambda points, pane=pane: -pane(points)) for pane in panes
    ]
    return blend(0.02, *outside)
