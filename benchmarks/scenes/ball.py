"""Build a mirror ball with a rough band about its equator. It is convex, so it reflects the environment and never itself."""

import numpy as np

from scripts.demo.shapes import Material, Scene, lathe

MATERIALS = (Material((0.95, 0.93, 0.88), 1.0, 0.03), Material((0.70, 0.30, 0.20), 1.0, 0.40))


def build() -> Scene:
    """Build the unit sphere; the band is |z| < 0.2."""

    def arc(start: float, end: float) -> list[tuple[float, float]]:
        return [(abs(np.cos(a)), np.sin(a)) for a in np.linspace(start, end, 65)]

    edge = np.arcsin(0.2)
    segments = [(0, arc(-np.pi / 2, -edge)), (1, arc(-edge, edge)[1:]), (0, arc(edge, np.pi / 2)[1:])]
    return Scene(lathe(segments, rows=240, columns=360), MATERIALS, light="interior", lowest=-0.9)
