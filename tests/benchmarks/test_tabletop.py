"""Test captures photographed as by hand: the true masks are what the cameras see of the object, and nothing else."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from benchmarks.masks import true_masks
from benchmarks.scenes import tabletop
from benchmarks.scenes.by_hand import FLOOR, WALL
from refgs.capture import read_capture

ROOT = Path(__file__).parents[2]
WIDTH, HEIGHT = 64, 48
TINY = ("--width", WIDTH, "--photos", 4, "--samples", 1)


def run(*arguments):
    command = [sys.executable, "-m", "benchmarks.scenes.tabletop", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def solid(part):
    """Return a part's mesh where it stands."""
    cos, sin = np.cos(part.turn), np.sin(part.turn)
    vertices = part.mesh.vertices @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) + part.at
    return trimesh.Trimesh(vertices, part.mesh.triangles, process=False)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Photograph the mug, by `all`: every other scene is there already."""
    pytest.importorskip("bpy", reason="Blender as a Python module renders the scenes")
    out = tmp_path_factory.mktemp("all")
    for name in set(tabletop.SCENES) - {"mug_in_sun"}:
        (out / name).mkdir()
    process = run("all", "--out", out, *TINY)
    assert process.returncode == 0, process.stderr
    assert {path.name for path in out.iterdir()} == set(tabletop.SCENES), "a temporary folder was left"
    return out / "mug_in_sun"


def test_a_capture_has_cameras_and_neither_masks_nor_points(capture):
    read = read_capture(capture)
    assert [view.camera.name for view in read.views] == ["000", "001", "002", "003"]
    assert not any(view.masked for view in read.views) and read.points is None
    for view in read.views:
        assert (view.camera.width, view.camera.height) == (WIDTH, HEIGHT)
        assert cv2.imread(str(capture / "images" / f"{view.camera.name}.jpg")).shape == (HEIGHT, WIDTH, 3)


def test_true_masks_are_the_true_mesh_with_its_hole(capture):
    transforms, masks = json.loads((capture / "transforms.json").read_text()), true_masks(capture)
    mug, holes = solid(tabletop.mug()), 0
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = np.stack([x, -y, np.full_like(x, -transforms["fl_x"])], -1).reshape(-1, 3)
    for frame in transforms["frames"]:
        pose, mask = np.array(frame["transform_matrix"]), masks[Path(frame["file_path"]).stem]
        seen = mug.ray.intersects_any(np.broadcast_to(pose[:3, 3], rays.shape), rays @ pose[:3, :3].T)
        seen = seen.reshape(HEIGHT, WIDTH)
        assert (seen & mask).sum() > 0.96 * (seen | mask).sum()
        holes += cv2.connectedComponents((~mask).astype(np.uint8), connectivity=4)[0] - 2
    assert holes > 0, "no photo shows the floor through the handle"


HIDDEN = """
import os, sys
from pathlib import Path
import numpy as np
from benchmarks.scenes.by_hand import Still, photograph, standing
from benchmarks.scenes.tabletop import GOLD, GREY, block
object = (standing(block(), (GOLD,), 0.0, 1.0), standing(block(), (GOLD,), 0.0, -1.0, turn=np.pi / 2))
light = np.ones((4, 8, 3), np.float32)
for name, around in (("free", ()), ("hidden", (standing(block(), (GREY,), 1.5, 1.0),))):
    photograph(Still(object, around, light), np.array([0, 1e-9]), np.radians([8, 8]), Path(sys.argv[1], name), 64, 1)
os._exit(0)  # Blender sometimes hangs when it cleans up
"""


def test_what_stands_before_the_object_is_not_in_its_mask(tmp_path):
    pytest.importorskip("bpy")
    subprocess.run([sys.executable, "-c", HIDDEN, tmp_path], cwd=ROOT, capture_output=True, check=True)
    free, hidden = true_masks(tmp_path / "free")["000"], true_masks(tmp_path / "hidden")["000"]
    right, left = (free & (np.arange(WIDTH) >= WIDTH // 2), free & (np.arange(WIDTH) < WIDTH // 2))
    assert right.sum() > 80 and left.sum() > 80, "the two blocks stand on either side"
    assert (hidden & left).sum() == left.sum() and (hidden & right).sum() < 0.5 * right.sum()
    assert not (hidden & ~free).any()


@pytest.mark.parametrize("name", tabletop.SCENES)
def test_objects_stand_before_the_cameras_within_the_room(name, cells):
    still = tabletop.SCENES[name]()
    corners = np.array([solid(part).bounds for part in still.object])
    assert corners[:, 0, 2] == pytest.approx(FLOOR), "an object floats"
    assert np.abs((corners[:, 0, :2].min(0) + corners[:, 1, :2].max(0)) / 2).max() < 0.35
    assert np.abs(corners).max() < 1.7
    for part in still.around:
        assert np.abs(part.mesh.vertices[:, :2] + part.at[:2]).max() <= WALL + 1e-9
        for index, material in enumerate(part.materials):
            points = part.mesh.vertices[:: max(1, len(part.mesh.vertices) // 1000)]
            if callable(material.base_color):
                colors = material.base_color(points)
                assert colors.shape == points.shape and colors.min() >= 0 and colors.max() <= 1
            assert index in part.mesh.material


def test_a_folder_that_exists_is_one_line(tmp_path):
    process = run("mug_in_sun", "--out", tmp_path)
    assert process.returncode == 2 and "exists" in process.stderr.splitlines()[-1]
    assert not list(tmp_path.iterdir())
