"""Photograph a can of brushed aluminium on a tiled floor, as by hand with a phone: `python -m benchmarks.scenes.can --out DIR`.

The can's print has the floor's colours, its metal mirrors the floor, and the glazed tiles mirror the can. Nothing tells object from floor
by colour. The capture has cameras, in `transforms.json`, and no masks. The true ones are in DIR/ground_truth/masks.
"""

import os
import sys
from collections.abc import Sequence

import numpy as np

from benchmarks.scenes import by_hand
from benchmarks.scenes.by_hand import Still, floor, photograph, standing, walls, window_light
from benchmarks.scenes.textures import clouds
from scripts.demo.shapes import Material, Mesh, lathe, mix, step

RADIUS = 0.54  # of the can, which is 2 units, or 12 cm, high
TILE, GROUT = 1.7, 0.06
GLAZE = ((0.50, 0.36, 0.24), (0.36, 0.20, 0.12), (0.62, 0.50, 0.38))
"""Base colours of the tiles, and of the print on the can."""


def printed(points: np.ndarray) -> np.ndarray:
    """Compute where the can is painted: 1 on the print, 0 on bare metal."""
    across, z = RADIUS * np.arctan2(points[:, 1], points[:, 0]), points[:, 2]
    patch = step(-0.02, 0.02, clouds(np.stack([across, z, 0 * z], -1), 0.9, seed=7) + 0.45)
    return patch * step(0.85, 0.84, np.abs(z)) * step(RADIUS - 0.03, RADIUS - 0.02, np.hypot(*points[:, :2].T))


def ink(points: np.ndarray) -> np.ndarray:
    """Compute the can's base colours: those of the tiles and of the grout on the print, aluminium beside it."""
    tone = clouds(points, 0.7, seed=8)
    paint = mix(mix(GLAZE[0], GLAZE[1], step(-0.1, 0.1, tone)), GLAZE[2], step(0.3, 0.5, tone))
    paint *= (1 + 0.22 * clouds(points, 0.5, seed=9))[:, None]
    paint = mix(paint, (0.20, 0.19, 0.18), step(0.02, 0.01, np.abs(points[:, 2] % 0.5 - 0.25)))
    return mix((0.91, 0.915, 0.92), paint, printed(points))


def tiles(points: np.ndarray) -> np.ndarray:
    """Compute the floor's base colours: glazed tiles, each of its own tone, mottled, with grout between them."""
    cell = np.floor(points[:, :2] / TILE)
    tone = np.sin(12.9898 * cell[:, 0] + 78.233 * cell[:, 1]) * 43758.5453 % 1
    glaze = mix(mix(GLAZE[0], GLAZE[1], step(0.3, 0.5, tone)), GLAZE[2], step(0.6, 0.8, tone))
    glaze *= (1 + 0.22 * clouds(points, 0.5, seed=9))[:, None]
    return mix(glaze, (0.20, 0.19, 0.18), grout(points))


def grout(points: np.ndarray) -> np.ndarray:
    """Compute where the floor is grout, not tile."""
    edge = np.abs((points[:, :2] / TILE) % 1 - 0.5).max(axis=1)
    return step(0.5 - GROUT / TILE, 0.5 - 0.6 * GROUT / TILE, edge)


def wall(points: np.ndarray) -> np.ndarray:
    """Compute the walls' base colours: plaster with posters, and a skirting board in the floor's colour."""
    along = points[:, 0] - points[:, 1]
    plaster = np.array([0.62, 0.58, 0.52]) * (1 + 0.06 * clouds(points, 6.0, seed=1))[:, None]
    poster = mix((0.10, 0.16, 0.30), (0.60, 0.20, 0.10), step(-0.2, 0.2, clouds(points, 3.0, seed=2)))
    hung = step(0.3, 0.35, np.sin(0.45 * along)) * step(5.0, 4.9, np.abs(points[:, 2] - 13.0))
    return mix(mix(plaster, poster, hung), GLAZE[1], points[:, 2] < 0.6)


ALUMINIUM = Material(ink, lambda p: 1 - printed(p), lambda p: 0.25 + 0.1 * printed(p), lambda p: 0.7 * (1 - printed(p)))
TILES = Material(tiles, 0.0, lambda p: 0.10 + 0.6 * grout(p))
PLASTER = Material(wall, 0.0, 0.7)
PROFILE = [
    (0.0, -0.94), (0.40, -0.95), (0.42, -1.0), (0.45, -0.99), (RADIUS, -0.88), (RADIUS, 0.0), (RADIUS, 0.86),
    (0.46, 0.97), (0.45, 1.0), (0.42, 0.98), (0.41, 0.93), (0.20, 0.92), (0.0, 0.92),
]  # fmt: skip


def can() -> Mesh:
    """Build the can's mesh, two units high."""
    return lathe([(0, PROFILE)], rows=360, columns=420)


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line and render the capture, from two rings of cameras."""
    parser = by_hand.parser(__doc__.splitlines()[0], width=320, photos=48, samples=12)
    options = parser.parse_args(arguments)
    if options.out.exists():
        parser.error(f"{options.out} exists: choose another folder, or remove it")
    still = Still((standing(can(), (ALUMINIUM,)),), (floor(TILES), walls(PLASTER)), window_light())
    count = np.arange(options.photos)
    turns, heights = 2 * np.pi * count / options.photos, np.radians([48, 22])[count % 2]
    photograph(still, turns, heights, options.out, options.width, options.samples)


if __name__ == "__main__":
    main()
    sys.stderr.flush()
    os._exit(0)  # Blender sometimes hangs when it cleans up at the end of a process
