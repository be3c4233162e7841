"""Photograph an object where it stands, as by hand: from cameras that are not quite level or aimed, with exposures of their own.

The captures have cameras, in `transforms.json`, and neither masks nor points. The true masks are in `ground_truth/masks`.
"""

import argparse
import json
import sys
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from benchmarks.scenes.lights import overcast
from refgs.color import srgb_encode
from refgs.formats.exr import write_exr
from refgs.formats.panorama import directions
from scripts.demo.shapes import Material, Mesh, join, step

FLOOR = -1.0  # height of what the object stands on
WALL = 26.0  # distance of the walls from the middle
HEIGHT = 30.0  # of the walls


@dataclass(frozen=True)
class Part:
    """Hold a mesh with its materials, and where it stands: it is turned by `turn` radians about z, then moved by `at`.

    Textures are evaluated at the mesh's own vertices, before it is moved.
    """

    mesh: Mesh
    materials: tuple[Material, ...]
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: float = 0.0


@dataclass(frozen=True)
class Still:
    """Hold what is photographed: the object, all that surrounds it, and the light, a panorama in Blender's orientation."""

    object: tuple[Part, ...]
    around: tuple[Part, ...]
    light: np.ndarray


def standing(mesh: Mesh, materials: tuple[Material, ...], x: float = 0.0, y: float = 0.0, turn: float = 0.0) -> Part:
    """Stand a mesh on the floor, its origin above the point (x, y)."""
    return Part(mesh, materials, (x, y, FLOOR - mesh.vertices[:, 2].min()), turn)


def floor(material: Material, height: float = FLOOR) -> Part:
    """Build a floor from wall to wall. If it has a texture, its vertices are closer near the object, where the texture shows most."""
    middle, far = np.linspace(-9, 9, 700), np.linspace(9, WALL, 120)
    line = np.concatenate([-far[::-1], middle[1:-1], far])
    if not callable(material.base_color):
        line = np.array([-WALL, WALL])
    return Part(_sheet(lambda u, v: (u, v, np.full_like(u, height)), line, line), (material,))


def walls(material: Material, bottom: float = FLOOR) -> Part:
    """Build four walls. One has a window, and there is no ceiling, so that the sky lights the room."""
    line, high = np.linspace(-WALL, WALL, 160), np.linspace(bottom, HEIGHT, 100)
    sides = (
        _sheet(lambda u, v: (u, np.full_like(u, WALL), v), line, high),
        _sheet(lambda u, v: (u, np.full_like(u, -WALL), v), line, high),
        _sheet(lambda u, v: (np.full_like(u, WALL), u, v), line, high),
        _sheet(lambda u, v: (np.full_like(u, -WALL), u, v), line, high[high < 8]),  # the window is above
    )
    return Part(join(*sides), (material,))


@cache
def window_light() -> np.ndarray:
    """Make an overcast sky that is bright before the window, so that objects throw a soft shadow."""
    sky = overcast()
    way = directions(*sky.shape[:2])
    return sky * (1 + 7 * step(0.80, 0.95, way @ np.array([-0.85, 0.15, 0.5])))[..., None]


def hand_held(turns: np.ndarray, heights: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Place cameras roughly at these angles around and above the object. They are not quite level or aimed.

    `turns` and `heights` (n,) are in radians; `turns` are evenly spaced. Returns camera-to-world matrices (n, 4, 4) with OpenGL's axes.
    """
    poses = []
    for turn, height in zip(turns, heights, strict=True):
        turn = turn + 0.4 * (turns[1] - turns[0]) * generator.normal()
        height = height + np.radians(3) * generator.normal()
        away = np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)])
        position, aim = (9 + 0.6 * generator.normal()) * away, 0.25 * generator.normal(size=3)
        back = (position - aim) / np.linalg.norm(position - aim)
        up = np.array([*(0.05 * generator.normal(size=2)), 1.0])
        right = np.cross(up, back) / np.linalg.norm(np.cross(up, back))
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
        poses.append(pose)
    return np.array(poses)


def photograph(still: Still, turns: np.ndarray, heights: np.ndarray, out: Path, width: int, samples: int) -> None:
    """Render a photo from each of the angles of `hand_held`, and the true masks, into the new folder `out`.

    Photos are four to three, `width` pixels wide. A mask is the fraction of each pixel (0 to 255) that the object covers.
    """
    from scripts.demo.cycles import FIELD_OF_VIEW, Renderer

    generator = np.random.default_rng(0)
    first, *others = still.object
    renderer = Renderer(first.mesh, first.materials, width, samples)
    scene, size = renderer.scene, (width, width * 3 // 4)
    scene.render.resolution_y = size[1]
    objects = [scene.objects["Object"], *(renderer.add(part.mesh, part.materials) for part in others)]
    around = [renderer.add(part.mesh, part.materials) for part in still.around]
    for part, added in zip(still.object + still.around, objects + around, strict=True):
        added.location, added.rotation_euler = part.at, (0, 0, part.turn)
    scene.render.film_transparent = False
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as scratch:
        folder, light = Path(scratch, out.name), Path(scratch, "light.exr")
        write_exr(light, still.light)
        renderer.set_light(light)
        (folder / "images").mkdir(parents=True)
        (folder / "ground_truth" / "masks").mkdir(parents=True)
        poses = hand_held(turns, heights, generator)
        for i, pose in enumerate(poses):
            color = renderer.render(pose, seed=i)["color"][..., 2::-1] * 2 ** (0.25 * generator.normal())
            noisy = 255 * srgb_encode(color).clip(0, 1) + generator.normal(0, 2, color.shape)
            quality = [cv2.IMWRITE_JPEG_QUALITY, 92]
            cv2.imwrite(str(folder / "images" / f"{i:03d}.jpg"), noisy.round().clip(0, 255).astype(np.uint8), quality)
            print(f"{out.name}: photo {i + 1} of {len(poses)}", file=sys.stderr)
        # What surrounds the object is cut out of the pictures, and still hides what is behind it. Only coverage is asked for: no light.
        scene.render.film_transparent, scene.world = True, None
        scene.cycles.use_denoising, scene.cycles.samples, scene.cycles.max_bounces = False, 8, 0
        for surrounding in around:
            surrounding.is_holdout = True
        for i, pose in enumerate(poses):
            alpha = renderer.render(pose, seed=i)["alpha"]
            cv2.imwrite(str(folder / "ground_truth" / "masks" / f"{i:03d}.png"), (255 * alpha).round().astype(np.uint8))
        focal = 0.5 * width / np.tan(0.5 * FIELD_OF_VIEW)
        frames = [{"file_path": f"images/{i:03d}.jpg", "transform_matrix": p.tolist()} for i, p in enumerate(poses)]
        data = {"fl_x": focal, "fl_y": focal, "cx": size[0] / 2, "cy": size[1] / 2, "w": size[0], "h": size[1]}
        (folder / "transforms.json").write_text(json.dumps(data | {"frames": frames}, indent=1))
        folder.rename(out)


def parser(description: str, width: int, photos: int, samples: int) -> argparse.ArgumentParser:
    """Make a parser of the arguments that all captures share, with these defaults."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder")
    parser.add_argument("--width", type=int, default=width, help=f"of the photos, in pixels ({width})")
    parser.add_argument("--photos", type=int, default=photos, help=f"how many ({photos})")
    parser.add_argument(
        "--samples", type=int, default=samples, help=f"Cycles samples a pixel, before denoising ({samples})"
    )
    return parser


def _sheet(place, u: np.ndarray, v: np.ndarray) -> Mesh:
    """Build a rectangular sheet with vertices at all pairs of `u` and `v`; `place(u, v)` returns their x, y and z."""
    grid = np.stack(place(*np.meshgrid(u, v, indexing="ij")), axis=-1).reshape(-1, 3)
    first = (np.arange(len(u) - 1)[:, None] * len(v) + np.arange(len(v) - 1)).ravel()
    a, b, c, d = first, first + len(v), first + len(v) + 1, first + 1
    triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    return Mesh(grid, triangles, np.zeros(len(triangles), int))
