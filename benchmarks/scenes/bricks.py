"""Build a toy loader of studded plastic bricks, with an open bucket and fine gaps, two chrome rods and a brass horn.

Bright plastic behind gaps, in the shade of other bricks, changes from photo to photo as long as the learned shape closes the gaps.
"""

import numpy as np

from benchmarks.scenes.solids import blend, box, carve, disc, placed, ring, sculpt, sweep
from scripts.demo.shapes import Material, Mesh, Scene, join, moved

YELLOW, RED, TAN, GREY, BLACK, BLUE, CHROME, BRASS = range(8)
MATERIALS = (
    Material((0.82, 0.47, 0.015), metallic=0.0, roughness=0.15),
    Material((0.55, 0.025, 0.015), metallic=0.0, roughness=0.12),
    Material((0.66, 0.52, 0.33), metallic=0.0, roughness=0.25),
    Material((0.33, 0.34, 0.36), metallic=0.0, roughness=0.20),
    Material((0.015, 0.015, 0.016), metallic=0.0, roughness=0.30),
    Material((0.02, 0.14, 0.52), metallic=0.0, roughness=0.12),
    Material((0.65, 0.68, 0.70), metallic=1.0, roughness=0.08),
    Material((0.91, 0.78, 0.42), metallic=1.0, roughness=0.12),
)
UNIT, HIGH, CELL = 0.11, 0.13, 0.009
"""Distance of studs, height of a brick, and length of edges."""


def _brick(at: tuple[int, int, float], size: tuple[int, int], height: float, material: int) -> Mesh:
    """Make a brick of `size` studs. Its lower corner is at the stud `at`, at that many heights of a brick above the plate."""
    half = np.array([size[0] * UNIT, size[1] * UNIT, height * HIGH]) / 2
    low = np.array([at[0] * UNIT, at[1] * UNIT, at[2] * HIGH])
    body = sculpt(box((0, 0, 0), half - 0.002, 0.008), -half - 0.01, half + 0.01, CELL, material)
    stud = sculpt(disc((0, 0, 0), (0, 0, 1), 0.031, 0.022, 0.006), (-0.04,) * 3, (0.04,) * 3, 0.006, material)
    studs = [
        moved(stud, (*(((np.array([x, y]) + 0.5) * UNIT) - half[:2]), half[2] + 0.010))
        for x in range(size[0])
        for y in range(size[1])
    ]
    return moved(join(body, *studs), tuple(low + half))


def _bucket() -> Mesh:
    """Make an open bucket with thin walls and teeth, tilted forwards."""
    outside, inside = box((0, 0, 0), (0.17, 0.36, 0.15), 0.02), box((0.05, 0, 0.05), (0.20, 0.335, 0.175), 0.02)
    solid = blend(
        0.01,
        carve(0.01, outside, inside),
        *(box((0.17, y, -0.14), (0.05, 0.02, 0.01), 0.008) for y in np.linspace(-0.3, 0.3, 7)),
    )
    tilt = np.deg2rad(25)
    axes = [[np.cos(tilt), 0, -np.sin(tilt)], [0, 1, 0], [np.sin(tilt), 0, np.cos(tilt)]]
    return sculpt(placed(solid, (0.72, 0, 0.36), axes), (0.4, -0.45, 0.1), (1.02, 0.45, 0.7), 0.008, YELLOW)


def build() -> Scene:
    """Build the loader along +x on a plate 2 units long."""
    plate = _brick((-9, -5, -0.4), (18, 10), 0.4, TAN)
    bricks = [
        _brick((-6, -2, 1.2), (9, 4), 1.0, YELLOW),
        _brick((-6, -3, 1.0), (3, 6), 0.4, GREY),
        _brick((-5, -2, 2.2), (4, 1), 1.0, YELLOW),
        _brick((-5, 1, 2.2), (4, 1), 1.0, YELLOW),
        _brick((-5, -2, 4.6), (4, 4), 0.4, YELLOW),
        *(_brick((x, y, 3.2), (1, 1), 1.4, BLACK) for x in (-5, -2) for y in (-2, 1)),
        _brick((-4, -1, 2.2), (2, 2), 0.6, RED),
        _brick((0, -1, 2.2), (3, 2), 1.0, BLUE),
        _brick((1, -1, 3.2), (1, 2), 0.4, RED),
    ]
    wheels = [
        part
        for x in (-0.48, 0.20)
        for y in (-0.34, 0.34)
        for part in (
            sculpt(
                ring((x, y, 0.16), (0, 1, 0), 0.105, 0.052),
                (x - 0.2, y - 0.1, -0.02),
                (x + 0.2, y + 0.1, 0.34),
                CELL,
                BLACK,
            ),
            sculpt(
                disc((x, y, 0.16), (0, 1, 0), 0.075, 0.03, 0.01),
                (x - 0.1, y - 0.1, 0.0),
                (x + 0.1, y + 0.1, 0.3),
                CELL,
                GREY,
            ),
        )
    ]
    arms = [
        sculpt(
            sweep([(-0.05, y, 0.34), (0.20, y, 0.50), (0.42, y, 0.52), (0.58, y, 0.38)], 0.03),
            (-0.12, y - 0.05, 0.25), (0.66, y + 0.05, 0.62), 0.008, material,
        )
        for y, material in ((-0.29, YELLOW), (0.29, YELLOW), (-0.15, CHROME), (0.15, CHROME))
    ]  # fmt: skip
    horn = sculpt(
        sweep([(-0.33, 0, 0.66), (-0.25, 0, 0.70), (-0.15, 0, 0.70), (-0.06, 0, 0.70)], [0.02, 0.025, 0.03, 0.07]),
        (-0.45, -0.12, 0.55), (0.1, 0.12, 0.82), 0.007, BRASS,
    )  # fmt: skip
    return Scene(
        moved(join(plate, *bricks, *wheels, *arms, horn, _bucket()), (0, 0, -0.31)), MATERIALS, "sunrise", 0.05
    )
