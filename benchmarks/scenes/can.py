"""Photograph a can of brushed aluminium on a tiled floor, as by hand with a phone: `python -m benchmarks.scenes.can --out DIR`.

The can's print has the floor's colours, its metal mirrors the floor, and the glazed tiles mirror the can. Nothing tells object from floor
by colour. The capture has cameras, in `transforms.json`, and no masks. The true ones are in DIR/ground_truth/masks.
"""

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from benchmarks.scenes.lights import overcast
from benchmarks.scenes.textures import clouds
from refgs.color import srgb_encode
from refgs.formats.exr import write_exr
from refgs.formats.panorama import directions
from scripts.demo.shapes import Material, Mesh, Scene, join, lathe, mix, step

SIZE = (320, 240)
PHOTOS = 48
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


MATERIALS = (
    Material(ink, lambda p: 1 - printed(p), lambda p: 0.25 + 0.1 * printed(p), lambda p: 0.7 * (1 - printed(p))),
    Material(tiles, 0.0, lambda p: 0.10 + 0.6 * grout(p)),
    Material(wall, 0.0, 0.7),
)
PROFILE = [
    (0.0, -0.94), (0.40, -0.95), (0.42, -1.0), (0.45, -0.99), (RADIUS, -0.88), (RADIUS, 0.0), (RADIUS, 0.86),
    (0.46, 0.97), (0.45, 1.0), (0.42, 0.98), (0.41, 0.93), (0.20, 0.92), (0.0, 0.92),
]  # fmt: skip


def build_can() -> Scene:
    """Build the can, two units high."""
    return Scene(lathe([(0, PROFILE)], rows=360, columns=420), MATERIALS, light=window_light())


def window_light() -> np.ndarray:
    """Make an overcast sky that is bright before the window, so that the can throws a shadow."""
    sky = overcast()
    way = directions(*sky.shape[:2])
    return sky * (1 + 7 * step(0.80, 0.95, way @ np.array([-0.85, 0.15, 0.5])))[..., None]


def room() -> Mesh:
    """Build the floor and four walls. One has a window, and the ceiling is open, so that the sky lights the room."""
    near = np.concatenate([np.linspace(-26, -9, 120), np.linspace(-9, 9, 700)[1:-1], np.linspace(9, 26, 120)])
    floor = _sheet(lambda u, v: (u, v, np.full_like(u, -1.0)), near, near, 1)
    line, high = np.linspace(-26, 26, 160), np.linspace(-1, 30, 100)
    walls = [
        _sheet(lambda u, v: (u, np.full_like(u, 26.0), v), line, high, 2),
        _sheet(lambda u, v: (u, np.full_like(u, -26.0), v), line, high, 2),
        _sheet(lambda u, v: (np.full_like(u, 26.0), u, v), line, high, 2),
        _sheet(lambda u, v: (np.full_like(u, -26.0), u, v), line, high[high < 8], 2),  # the window is above
    ]
    return join(floor, *walls)


def hand_held(generator: np.random.Generator) -> np.ndarray:
    """Place the cameras in two rings, not quite round, level or aimed. Returns camera-to-world matrices with OpenGL's axes."""
    poses = []
    for i in range(PHOTOS):
        low = i % 2
        turn = 2 * np.pi * (i + 0.4 * generator.normal()) / PHOTOS
        height = np.radians((48, 22)[low] + 3 * generator.normal())
        away = np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)])
        position, aim = (9 + 0.6 * generator.normal()) * away, 0.25 * generator.normal(size=3)
        back = (position - aim) / np.linalg.norm(position - aim)
        up = np.array([*(0.05 * generator.normal(size=2)), 1.0])
        right = np.cross(up, back) / np.linalg.norm(np.cross(up, back))
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
        poses.append(pose)
    return np.array(poses)


def photograph(out: Path, samples: int) -> None:
    """Render the photos and the true masks into the new folder `out`. Exposures differ, as a phone's do."""
    from scripts.demo.cycles import FIELD_OF_VIEW, Renderer

    scene, generator = build_can(), np.random.default_rng(0)
    renderer = Renderer(scene.mesh, scene.materials, SIZE[0], samples)
    renderer.scene.render.resolution_y = SIZE[1]
    surroundings = renderer.add(room(), scene.materials)
    renderer.scene.render.film_transparent = False
    renderer.scene.cycles.max_bounces = 4
    folder = out.with_name(f".{out.name}.tmp")
    with tempfile.NamedTemporaryFile(suffix=".exr") as light:
        write_exr(Path(light.name), scene.light)
        renderer.set_light(Path(light.name))
        (folder / "images").mkdir(parents=True)
        (folder / "ground_truth" / "masks").mkdir(parents=True)
        poses = hand_held(generator)
        for i, pose in enumerate(poses):
            color = renderer.render(pose, seed=i)["color"][..., 2::-1] * 2 ** (0.25 * generator.normal())
            noisy = 255 * srgb_encode(color).clip(0, 1) + generator.normal(0, 2, color.shape)
            quality = [cv2.IMWRITE_JPEG_QUALITY, 92]
            cv2.imwrite(str(folder / "images" / f"{i:03d}.jpg"), noisy.round().clip(0, 255).astype(np.uint8), quality)
            print(f"photo {i + 1} of {PHOTOS}", file=sys.stderr)
        surroundings.hide_render, renderer.scene.render.film_transparent = True, True
        for i, pose in enumerate(poses):
            alpha = renderer.render(pose, seed=i)["alpha"]
            cv2.imwrite(str(folder / "ground_truth" / "masks" / f"{i:03d}.png"), (255 * alpha).round().astype(np.uint8))
    focal = 0.5 * SIZE[0] / np.tan(0.5 * FIELD_OF_VIEW)
    frames = [{"file_path": f"images/{i:03d}.jpg", "transform_matrix": pose.tolist()} for i, pose in enumerate(poses)]
    data = {"fl_x": focal, "fl_y": focal, "cx": SIZE[0] / 2, "cy": SIZE[1] / 2, "w": SIZE[0], "h": SIZE[1]}
    (folder / "transforms.json").write_text(json.dumps(data | {"frames": frames}, indent=1))
    folder.rename(out)


def _sheet(place, u: np.ndarray, v: np.ndarray, material: int) -> Mesh:
    """Build a rectangular sheet with vertices at all pairs of `u` and `v`; `place(u, v)` returns their x, y and z."""
    grid = np.stack(place(*np.meshgrid(u, v, indexing="ij")), axis=-1).reshape(-1, 3)
    first = (np.arange(len(u) - 1)[:, None] * len(v) + np.arange(len(v) - 1)).ravel()
    a, b, c, d = first, first + len(v), first + len(v) + 1, first + 1
    triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    return Mesh(grid, triangles, np.full(len(triangles), material))


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line and render the capture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder")
    parser.add_argument("--samples", type=int, default=12, help="Cycles samples a pixel, before denoising (12)")
    options = parser.parse_args(arguments)
    if options.out.exists():
        parser.error(f"{options.out} exists: choose another folder, or remove it")
    photograph(options.out, options.samples)


if __name__ == "__main__":
    main()
    sys.stderr.flush()
    os._exit(0)  # Blender sometimes hangs when it cleans up at the end of a process
