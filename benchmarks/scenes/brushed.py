"""Build a canister of brushed aluminium with a picture printed on it. Brushing along circles stretches the highlights up and down."""

import numpy as np

from scripts.demo.shapes import Material, Scene, join, lathe, mix, step, tube


def print_here(points: np.ndarray) -> np.ndarray:
    """Compute where the surface is painted: 1 on the print, 0 on bare metal."""
    across, z = _unrolled(points)
    outside = step(0.50, 0.51, np.hypot(points[:, 0], points[:, 1]))
    frame = _less(np.abs(across), 0.62) * _less(np.abs(z + 0.12), 0.40)
    line = _less(np.abs(z + 0.74), 0.025)
    return outside * np.maximum(line, frame * (1 - _bare(across, z)))


def ink(points: np.ndarray) -> np.ndarray:
    """Compute base colours: of a seaside at sunset on the print, of streaked aluminium beside it."""
    across, z = _unrolled(points)
    colour = mix((0.80, 0.55, 0.25), (0.55, 0.10, 0.05), step(0.0, 0.28, z + 0.05))
    colour = mix(colour, (0.85, 0.72, 0.30), _less(np.hypot(across + 0.1, z + 0.02), 0.16))
    waves = -0.14 + 0.018 * np.sin(22 * across)
    colour = mix(colour, (0.02, 0.13, 0.22), _less(z, waves))
    colour = mix(colour, (0.03, 0.22, 0.30), _less(z, waves - 0.10))
    colour = mix(colour, (0.015, 0.05, 0.10), _less(z, waves - 0.22))
    colour = mix(colour, (0.02, 0.13, 0.22), _less(z, -0.6))
    metal = np.array([0.91, 0.915, 0.92]) * (0.97 + 0.03 * _streaks(points))[:, None]
    painted = print_here(points)[:, None]
    return painted * colour + (1 - painted) * metal


def dull(points: np.ndarray) -> np.ndarray:
    """Compute roughness: of the paint, and of metal in streaks."""
    painted = print_here(points)
    return painted * 0.40 + (1 - painted) * (0.36 + 0.05 * _streaks(points))


METAL, KNOB = range(2)
MATERIALS = (
    Material(ink, lambda points: 1 - print_here(points), dull, brushed=lambda points: 0.8 * (1 - print_here(points))),
    Material((0.03, 0.028, 0.026), metallic=0.0, roughness=0.55),
)
BODY = [(0.0, -0.97), (0.48, -0.97), (0.515, -0.955), (0.53, -0.92), (0.53, -0.3), (0.53, 0.52), (0.53, 0.57)]
GAP = [(0.525, 0.585), (0.515, 0.59), (0.525, 0.595), (0.545, 0.605)]
LID = [(0.55, 0.62), (0.55, 0.74), (0.54, 0.775), (0.51, 0.79), (0.25, 0.80), (0.0, 0.80)]


def build() -> Scene:
    """Build the canister with a wooden-black knob, two units high."""
    knob = [(0.0, 0.79), (0.06, 0.79), (0.05, 0.83), (0.09, 0.88), (0.10, 0.93), (0.07, 0.965), (0.0, 0.97)]
    loop = np.array([(0.545, 0.0, 0.66), (0.63, 0.0, 0.64), (0.66, 0.0, 0.56), (0.63, 0.0, 0.48), (0.525, 0.0, 0.46)])
    mesh = join(
        lathe([(METAL, BODY + GAP + LID)], rows=520, columns=560),
        lathe([(KNOB, knob)], rows=80, columns=120),
        *(tube(loop * (sign, 1, 1), 0.018, METAL, closed=False) for sign in (1, -1)),
    )
    return Scene(mesh, MATERIALS, light="interior")


def _unrolled(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far points are around the canister, from its front, and how high."""
    return 0.53 * np.arctan2(points[:, 0], -points[:, 1]), points[:, 2]


def _less(values: np.ndarray, than) -> np.ndarray:
    return step(0.004, -0.004, values - than)


def _bare(across: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Compute where the picture leaves the metal bare: a frame, and the sails of a boat."""
    frame = _less(np.abs(np.maximum(np.abs(across) - 0.58, np.abs(z + 0.12) - 0.36)), 0.010)
    boat, up = across - 0.30, z + 0.15
    sail = _less(np.abs(boat) / 0.13 + up / 0.30, 1.0) * _less(0.012, np.abs(boat + 0.02)) * _less(0.0, up)
    return np.maximum(frame, sail)


def _streaks(points: np.ndarray) -> np.ndarray:
    """Compute the irregularity of the brushing, from −1 to 1: lines along circles about z."""
    along = points[:, 2] + np.hypot(points[:, 0], points[:, 1])
    angle = np.arctan2(points[:, 1], points[:, 0])
    waves = (np.sin(f * along + a * np.sin(angle + f)) for f, a in ((61, 1.0), (97, 1.7), (151, 2.3), (233, 3.1)))
    return sum(waves) / 4
