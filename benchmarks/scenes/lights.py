"""Make lights: panoramas (H, 2·H, 3) of linear radiance in Blender's orientation. Only `cellar` has small bright lamps."""

import numpy as np

from benchmarks.scenes.textures import clouds
from refgs.formats.panorama import directions
from scripts.demo.shapes import mix, step

HEIGHT = 512


def _ways() -> np.ndarray:
    """Return the unit directions of a panorama's pixels, row by row: (2·HEIGHT², 3)."""
    return directions(HEIGHT, 2 * HEIGHT).reshape(-1, 3).astype(float)


def overcast() -> np.ndarray:
    """Make an overcast sky over gravel with trees along the horizon. The zenith is three times as bright as the horizon (CIE)."""
    way = _ways()
    up = way[:, 2]
    sky = (1 + 2 * up.clip(0)) / 3 * (1 + 0.25 * clouds(way * [1, 1, 2], 0.7, seed=1))
    ground = mix((0.16, 0.155, 0.14), (0.27, 0.26, 0.24), step(-0.8, 0.8, clouds(way, 0.5, seed=2)))
    radiance = 1.1 * sky[:, None] * np.array([0.95, 1.0, 1.06])
    level = way * [1, 1, 0]
    trees = step(-0.02, 0.02, 0.10 + 0.07 * clouds(level, 0.25, seed=3) + 0.02 * clouds(level, 0.05, seed=4) - up)
    radiance = mix(radiance, (0.05, 0.07, 0.035), trees)
    return mix(radiance, ground, step(-0.02, 0.0, -up)).reshape(HEIGHT, 2 * HEIGHT, 3)


def museum() -> np.ndarray:
    """Make a room of pale walls with four broad panels of frosted glass in its ceiling, a doorway and a wooden floor."""
    way = _ways()
    wall = np.array([3.0, 3.0, 2.0])  # half the room's size; the object is in its middle
    along = (wall / np.abs(way).clip(1e-9)).min(axis=1)
    x, y, z = (way * along[:, None]).T
    radiance = mix((0.30, 0.28, 0.25), (0.52, 0.50, 0.46), step(-2.0, 2.0, z))
    door = step(0.9, 0.6, np.abs(y - 0.6)) * step(0.7, 0.4, z) * (x > 2.9)
    radiance = mix(radiance, (0.06, 0.055, 0.05), door)
    picture = step(1.1, 0.9, np.abs(x + 0.5)) * step(0.6, 0.45, np.abs(z - 0.3)) * (y > 2.9)
    radiance = mix(radiance, (0.16, 0.07, 0.05), picture)
    floor = mix((0.15, 0.10, 0.06), (0.22, 0.15, 0.09), step(-0.5, 0.5, np.sin(9 * y)))
    radiance = mix(radiance, floor, z < -1.99)
    panel = step(1.1, 0.6, np.abs(np.abs(x) - 1.4)) * step(0.9, 0.5, np.abs(np.abs(y) - 1.4)) * (z > 1.99)
    return mix(radiance, (2.6, 2.5, 2.3), panel).reshape(HEIGHT, 2 * HEIGHT, 3)


def white_studio() -> np.ndarray:
    """Make a photographer's tent: white cloth all around, brighter where two lamps light it, with the floor's edge and a dark slit."""
    way = _ways()
    up = way[:, 2]
    radiance = mix((0.62, 0.62, 0.63), (0.92, 0.92, 0.92), step(-0.8, 0.9, up + 0.1 * clouds(way, 0.8, seed=7)))
    for lamp, bright in (((0.75, 0.5, 0.43), 3.0), ((-0.8, 0.2, 0.55), 1.6)):
        cosine = way @ (np.array(lamp) / np.linalg.norm(lamp))
        radiance = radiance + step(0.72, 0.93, cosine)[:, None] * bright * np.array([1.0, 0.98, 0.95])
    slit = step(0.10, 0.06, np.abs(way[:, 0] - 0.15)) * (way[:, 1] < 0) * step(0.75, 0.70, np.abs(up))
    radiance = mix(radiance, (0.03, 0.03, 0.03), slit)
    edge = step(0.02, 0.0, np.abs(up + 0.35))
    return mix(radiance, (0.35, 0.34, 0.33), edge).reshape(HEIGHT, 2 * HEIGHT, 3)


def cellar() -> np.ndarray:
    """Make a dark cellar with two bulbs, a tube lamp and a small window at dusk. The walls are a thousand times darker than the lamps."""
    way = _ways()
    up = way[:, 2]
    radiance = mix((0.003, 0.0025, 0.002), (0.014, 0.012, 0.010), step(-1.0, 1.4, clouds(way, 0.4, seed=8) + up))
    window = step(0.16, 0.14, np.abs(way[:, 0] + 0.2)) * step(0.11, 0.09, np.abs(up - 0.35)) * (way[:, 1] < 0)
    radiance = mix(radiance, (0.22, 0.30, 0.42), window)
    tube = step(0.022, 0.014, np.abs(up - 0.62)) * step(0.34, 0.32, np.abs(way[:, 1] - 0.1)) * (way[:, 0] < 0)
    radiance = mix(radiance, (36.0, 40.0, 38.0), tube)
    for lamp, bright in (((0.7, 0.35, 0.60), 260.0), ((0.25, -0.75, 0.30), 130.0)):
        angle = np.arccos((way @ (np.array(lamp) / np.linalg.norm(lamp))).clip(-1, 1))
        radiance = mix(radiance, bright * np.array([1.0, 0.86, 0.66]), step(0.048, 0.036, angle))
    return radiance.reshape(HEIGHT, 2 * HEIGHT, 3)
