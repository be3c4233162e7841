"""Build still lifes by chance: a few things of random shapes and materials, in one of ten lights.

The weights of `refgs.train.material.reckoning`, which tell metal from paint, were fitted to these and a few other captures.
"""

import colorsys

import numpy as np

from benchmarks.scenes.lights import cellar, museum, overcast, white_studio
from benchmarks.scenes.solids import box, disc, ring, sculpt
from benchmarks.scenes.textures import clouds
from scripts.demo.shapes import Material, Mesh, Scene, Texture, join, lathe, mix, moved, step

# Linear F0 of silver, aluminium, chromium, titanium, iron, gold, copper, brass, bronze: https://physicallybased.info
METALS = (
    (0.962, 0.949, 0.922),
    (0.916, 0.923, 0.924),
    (0.654, 0.685, 0.701),
    (0.441, 0.400, 0.361),
    (0.530, 0.513, 0.494),
    (1.059, 0.773, 0.307),
    (0.932, 0.623, 0.522),
    (0.910, 0.778, 0.423),
    (0.800, 0.640, 0.440),
)
LIGHTS = (
    "studio",
    museum,
    "forest",
    cellar,
    "interior",
    white_studio,
    "night",
    "courtyard",
    overcast,
    "sunset",
)
FLOOR = -0.45
SPOTS = ((0.42, 0.28), (-0.38, 0.36), (-0.40, -0.34), (0.30, -0.44))
"""Places on the base, each with room for a thing 0.3 units in radius."""

Profile = list[tuple[float, float]]


def build(number: int) -> Scene:
    """Build the still life `number`, 0 or more, about 2 units wide."""
    chance = np.random.default_rng(1000 + number)
    materials: list[Material] = []

    def material() -> int:
        materials.append(_metal(chance) if chance.random() < 0.5 else _paint(chance, number))
        return len(materials) - 1

    spots = chance.permutation(len(SPOTS))[: chance.integers(2, 5)]
    parts = [moved(_thing(chance, material), (*SPOTS[spot], FLOOR)) for spot in spots]
    base = _base(chance, material())
    if not any(_is_metal(each) for each in materials):
        materials[0] = _metal(chance)
    if all(_is_metal(each) for each in materials):
        materials[-1] = _paint(chance, number)
    light = LIGHTS[number % len(LIGHTS)]
    return Scene(
        moved(join(*parts, base), (0, 0, 0.14)), tuple(materials), light if isinstance(light, str) else light(), 0.0
    )


def _is_metal(material: Material) -> bool:
    return material.metallic == 1.0


def _metal(chance: np.random.Generator) -> Material:
    color = np.clip(METALS[chance.integers(len(METALS))], 0, 1)
    return Material(tuple(color), metallic=1.0, roughness=float(0.03 + 0.35 * chance.random() ** 2))


def _paint(chance: np.random.Generator, seed: int) -> Material:
    """Make glossy or matte paint of a random colour, every third time with clouds of a second one."""
    one, other = (
        np.array(colorsys.hsv_to_rgb(chance.random(), chance.random() ** 0.7, 0.02 + 0.8 * chance.random() ** 1.5))
        for _ in range(2)
    )
    glossy = chance.random() < 0.6
    roughness = float(chance.uniform(0.03, 0.15) if glossy else chance.uniform(0.25, 0.9))
    color: tuple[float, ...] | Texture = tuple(one)
    if chance.random() < 1 / 3:
        size = float(chance.uniform(0.1, 0.5))

        def color(points: np.ndarray) -> np.ndarray:
            return mix(one, other, step(-0.2, 0.2, clouds(points, size, seed)))

    return Material(color, metallic=0.0, roughness=roughness)


def _base(chance: np.random.Generator, material: int) -> Mesh:
    """Make a disc or a board under everything."""
    if chance.random() < 0.5:
        solid = disc((0, 0, FLOOR - 0.05), (0, 0, 1), 0.98, 0.05, 0.03)
    else:
        solid = box((0, 0, FLOOR - 0.05), (0.92, 0.86, 0.05), 0.02)
    return sculpt(solid, (-1, -1, FLOOR - 0.12), (1, 1, FLOOR + 0.02), 0.012, material)


def _thing(chance: np.random.Generator, material) -> Mesh:
    """Make a ball, vase, cup, bowl, cone, box or ring that stands on the height 0. `material()` adds a material and returns its index."""
    kind = chance.integers(7)
    size = float(chance.uniform(0.22, 0.34))
    if kind == 0:
        angles = np.linspace(-np.pi / 2, np.pi / 2, 65)
        return _turned([(material(), [(size * abs(np.cos(a)), size + size * np.sin(a)) for a in angles])])
    if kind == 1:
        return _vase(chance, size, material)
    if kind in (2, 3):
        return _turned([(material(), _hollow(size, height=float(chance.uniform(1.6, 2.2) if kind == 2 else 0.9)))])
    if kind == 4:
        top = float(chance.uniform(0.1, 0.6))
        profile = [(0.0, 0.0), (size, 0.0), (1.04 * size, 0.02), (top * size, 2.2 * size), (0.0, 2.25 * size)]
        return _turned([(material(), profile)])
    if kind == 5:
        half = size * chance.uniform(0.6, 1.0, 3)
        solid = box((0, 0, half[2]), half, float(chance.uniform(0.02, 0.1)))
        return sculpt(solid, tuple(-half - 0.05), tuple(half * [1, 1, 2] + 0.05), 0.010, material())
    thick = 0.35 * size
    solid = ring((0, 0, size + thick), (1, 0, 0), size, thick)
    return sculpt(
        solid, (-thick - 0.05, -0.5, -0.05), (thick + 0.05, 0.5, 2 * (size + thick) + 0.05), 0.010, material()
    )


def _vase(chance: np.random.Generator, size: float, material) -> Mesh:
    """Make a closed vase of a random profile, every second time with a neck of another material."""
    heights = np.linspace(0.08, 2.6, 5) * size
    radii = size * chance.uniform(0.4, 1.0, 5)
    body = [(0.0, 0.0), (0.8 * radii[0], 0.0), *zip(radii.tolist(), heights.tolist(), strict=True)]
    end = [(float(radii[-1]) * 0.5, float(heights[-1]) + 0.02), (0.0, float(heights[-1]) + 0.025)]
    first = material()
    if chance.random() < 0.5:
        return _turned([(first, body[:5]), (material(), [*body[5:], *end])])
    return _turned([(first, [*body, *end])])


def _hollow(size: float, height: float) -> Profile:
    """Return the profile of an open cup or bowl."""
    outside = [(0.0, 0.0), (0.5 * size, 0.0), (0.8 * size, 0.25 * height * size), (0.95 * size, 0.6 * height * size)]
    rim = [(size, height * size), (0.97 * size, height * size + 0.01), (0.93 * size, height * size)]
    inside = [(0.88 * size, 0.6 * height * size), (0.7 * size, 0.3 * height * size), (0.0, 0.12 * height * size)]
    return outside + rim + inside


def _turned(segments: list[tuple[int, Profile]]) -> Mesh:
    return lathe(segments, rows=260, columns=260)
