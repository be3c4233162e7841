"""Photograph objects that stand on something, as by hand: `python -m benchmarks.scenes.tabletop NAME --out DIR`.

Each scene is hard to cut out in a way of its own: a shadow, a mirror image, a hole, an object in the colour of what it stands on, other
objects nearby. `all` renders each scene that DIR doesn't hold yet into DIR/NAME.
"""

import os
import sys
from collections.abc import Sequence

import numpy as np

from benchmarks.scenes import by_hand, silver, teapot
from benchmarks.scenes.by_hand import FLOOR, Part, Still, floor, photograph, standing, walls, window_light
from benchmarks.scenes.can import ALUMINIUM, PLASTER, can
from benchmarks.scenes.lights import overcast
from benchmarks.scenes.solids import box, sculpt
from benchmarks.scenes.textures import clouds
from refgs.formats.panorama import directions
from scripts.demo import jar
from scripts.demo.shapes import Material, Mesh, join, lathe, mix, step, tube

PLANK = 0.9  # width of the floor's planks
TABLE = 7.0  # the table's height above the room's floor


def planks(points: np.ndarray) -> np.ndarray:
    """Compute base colours of wooden planks along x: each of its own tone, with grain, and dark gaps between them."""
    row = np.floor(points[:, 1] / PLANK)
    tone = np.sin(12.9898 * row) * 43758.5453 % 1
    grain = clouds(points * [0.12, 1, 1] + 7 * tone[:, None], 0.25, seed=3)
    wood = mix((0.36, 0.20, 0.10), (0.55, 0.36, 0.20), tone) * (1 + 0.18 * grain)[:, None]
    return mix(wood, (0.05, 0.03, 0.02), step(0.47, 0.49, np.abs(points[:, 1] / PLANK % 1 - 0.5)))


def stone(points: np.ndarray) -> np.ndarray:
    """Compute base colours of dark polished stone with pale veins and specks."""
    vein = step(0.08, 0.0, np.abs(clouds(points, 2.5, seed=4)))
    speck = step(0.9, 1.4, clouds(points, 0.15, seed=5))
    return mix(mix((0.05, 0.055, 0.06), (0.20, 0.19, 0.17), speck), (0.42, 0.40, 0.36), vein)


def paint(points: np.ndarray) -> np.ndarray:
    """Compute base colours of the mug: red with a cream band and blue dots, and cream inside."""
    angle, z, radius = np.arctan2(points[:, 1], points[:, 0]), points[:, 2], np.hypot(*points[:, :2].T)
    dots = np.hypot((angle * 6 / np.pi) % 1 - 0.5, (z - 0.05) / 0.42)
    band = mix((0.75, 0.66, 0.48), (0.05, 0.12, 0.35), step(0.32, 0.28, dots))
    outside = mix((0.45, 0.06, 0.04), band, step(0.32, 0.30, np.abs(z - 0.05)) * (radius < 0.72))
    return mix(outside, (0.75, 0.66, 0.48), (radius < 0.62) & (z > -0.75))


GOLD = Material((0.944, 0.720, 0.330), metallic=1.0, roughness=0.12)
WOOD = Material(planks, 0.0, 0.45)
STONE = Material(stone, 0.0, 0.04)
GREY = Material((0.32, 0.32, 0.32), 0.0, 0.7)
WHITE = Material((0.80, 0.80, 0.79), 0.0, 0.6)
PORCELAIN = Material((0.80, 0.80, 0.78), 0.0, 0.15)
MUG = [
    (0.0, -0.85), (0.50, -0.86), (0.54, -0.90), (0.60, -0.88), (0.67, -0.78), (0.68, 0.0), (0.68, 0.82),
    (0.65, 0.86), (0.61, 0.82), (0.61, 0.0), (0.60, -0.70), (0.54, -0.76), (0.0, -0.76),
]  # fmt: skip


def block() -> Mesh:
    """Build a block with rounded edges."""
    half = np.array([0.75, 0.5, 0.45])
    return sculpt(box((0, 0, 0), half, 0.06), -half, half, 0.02, 0)


def mug() -> Part:
    """Build a painted mug. The floor shows through its handle."""
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 24)
    handle = np.stack([0.66 + 0.55 * np.cos(angle), 0 * angle, 0.02 + 0.55 * np.sin(angle)], axis=1)
    mesh = join(lathe([(0, MUG)], rows=300, columns=360), tube(handle, 0.085, 0, closed=False))
    return standing(mesh, (Material(paint, 0.0, 0.3),), turn=0.6)


def gold_on_planks() -> Still:
    """Stand a block of polished gold, which mirrors the planks below it, in a room."""
    return Still((standing(block(), (GOLD,), turn=0.5),), (floor(WOOD), walls(PLASTER)), window_light())


def pair_on_grey() -> Still:
    """Stand the block and a printed can side by side on a floor without texture. Both are the object, and throw soft shadows."""
    pair = (standing(block(), (GOLD,), 0.75, 0.1, turn=0.4), standing(can(), (ALUMINIUM,), -0.85, -0.1))
    return Still(pair, (floor(GREY), walls(PLASTER)), window_light())


def mug_in_sun() -> Still:
    """Stand a mug on a floor without texture, outdoors. The sun is half a degree in radius, so that shadows have hard edges."""
    sky = overcast()
    cosine = directions(*sky.shape[:2]) @ (np.array([-0.55, 0.5, 0.6]) / np.linalg.norm([-0.55, 0.5, 0.6]))
    sun = step(np.cos(np.radians(0.7)), np.cos(np.radians(0.3)), cosine)[..., None] * np.array([1.0, 0.95, 0.85])
    return Still((mug(),), (floor(GREY),), 0.6 * sky + 24000 * sun)


def teapot_on_stone() -> Still:
    """Stand a glazed teapot on polished stone, which mirrors it."""
    scene = teapot.build()
    return Still((standing(scene.mesh, scene.materials, turn=1.0),), (floor(STONE), walls(PLASTER)), window_light())


def white_on_white() -> Still:
    """Stand a white jug on a white table between white walls."""
    top = np.array([4.5, 4.5, 0.12])
    table = Part(sculpt(box((0, 0, 0), top, 0.05), -top, top, 0.1, 0), (WHITE,), (0, 0, FLOOR - top[2]))
    jug = standing(silver.build().mesh, (PORCELAIN, PORCELAIN), turn=0.8)
    room = (table, floor(WOOD, FLOOR - TABLE), walls(WHITE, FLOOR - TABLE))
    return Still((jug,), room, 0.6 * window_light())  # exposed for white


def cluttered_room() -> Still:
    """Stand an urn in a room with furniture, and two other things near it."""
    urn = jar.build()
    near = (standing(can(), (ALUMINIUM,), -2.1, -1.2), standing(block(), (GOLD,), 1.5, -2.2, turn=1.2))
    return Still(
        (standing(urn.mesh, urn.materials, turn=0.3),),
        (*near, *furniture(), floor(WOOD), walls(PLASTER)),
        window_light(),
    )


def furniture() -> tuple[Part, ...]:
    """Build plain boxes along the walls, as cupboards and chests."""
    boxes = (
        ((20, -6), (2.0, 5.0, 4.0), (0.10, 0.16, 0.22)),
        ((8, 22), (6.0, 2.0, 2.0), (0.45, 0.10, 0.06)),
        ((-14, 19), (3.0, 3.0, 5.5), (0.55, 0.50, 0.40)),
        ((-21, -9), (2.5, 6.0, 1.6), (0.12, 0.24, 0.10)),
        ((4, -21), (7.0, 2.2, 3.2), (0.30, 0.18, 0.09)),
    )
    parts = []
    for (x, y), half, color in boxes:
        half = np.array(half)
        mesh = sculpt(box((0, 0, 0), half, 0.3), -half, half, 0.25, 0)
        parts.append(standing(mesh, (Material(color, 0.0, 0.5),), x, y, turn=0.1 * x))
    return tuple(parts)


SCENES = {
    "gold_on_planks": gold_on_planks,
    "pair_on_grey": pair_on_grey,
    "mug_in_sun": mug_in_sun,
    "teapot_on_stone": teapot_on_stone,
    "white_on_white": white_on_white,
    "cluttered_room": cluttered_room,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line and render the scenes that it names, from one and a half rising rings of cameras."""
    parser = by_hand.parser(__doc__.splitlines()[0], width=480, photos=40, samples=2)
    parser.add_argument("name", choices=[*SCENES, "all"], metavar="NAME", help=f"{', '.join(SCENES)}, or all")
    options = parser.parse_args(arguments)
    captures = {options.name: options.out}
    if options.name == "all":
        captures = {name: options.out / name for name in SCENES if not (options.out / name).exists()}
    elif options.out.exists():
        parser.error(f"{options.out} exists: choose another folder, or remove it")
    turns = np.linspace(0, 3 * np.pi, options.photos, endpoint=False)
    heights = np.radians(np.linspace(13, 57, options.photos))
    for name, out in captures.items():
        photograph(SCENES[name](), turns, heights, out, options.width, options.samples)


if __name__ == "__main__":
    main()
    sys.stderr.flush()
    os._exit(0)  # Blender sometimes hangs when it cleans up at the end of a process
