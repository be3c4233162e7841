"""Test the benchmark on captures of real objects, with a small rendered capture: it trains, exports, and writes a page with pictures."""

import cv2
import numpy as np
import pytest
import trimesh

from benchmarks import harness, real
from refgs import cli
from refgs.capture import silhouettes
from refgs.errors import InputError
from tests.makers.captures import nerfstudio

SMALL = """
base = "quick"
[surfels]
start = 600
budget = 800
hull = 48
[train]
iterations = 40
light_first = 0
[indirect]
resolution = 48
[mesh]
resolution = 48
texture = 64
"""


@pytest.fixture
def quick(monkeypatch):
    """Train and evaluate in this process, which has loaded torch, and make coarse masks."""

    def call(*words):
        cli.app([*map(str, words)], standalone_mode=False)
        return 0

    monkeypatch.setattr(harness, "call", call)
    monkeypatch.setattr(silhouettes, "GRID", 24)
    monkeypatch.setattr(silhouettes, "ROUNDS", 3)


def test_captures_are_trained_and_shown_on_a_page(quick, tmp_path, capsys):
    nerfstudio(tmp_path / "captures" / "ball")
    (tmp_path / "captures" / "notes").mkdir()
    (tmp_path / "small.toml").write_text(SMALL)
    out = tmp_path / "out"
    words = ["--captures", str(tmp_path / "captures"), "--out", str(out), "--preset", str(tmp_path / "small.toml")]
    real.main([*words, "--side", "48", "32"])
    page = (out / "real-captures.md").read_text()
    assert "| ball | 32 px |" in page and "| ball | 48 px |" in page
    assert page.count("## ball") == 1 and "notes" not in page
    picture = cv2.imread(str(out / "ball.jpg"))
    assert picture.shape[0] == real.HEIGHT and picture.shape[1] > 4 * real.HEIGHT
    parts = np.array_split(picture, len(real.PASSES), axis=1)
    assert all(part.std() > 1 for part in (parts[0], parts[1], parts[2], parts[-1])), "a picture is empty"


def test_a_folder_without_captures_is_named(tmp_path):
    with pytest.raises(InputError, match="no capture with cameras"):
        harness.find_captures(tmp_path)


def test_pieces_are_counted_across_the_seams_of_textures(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=1)
    faces = ball.vertices[ball.faces].reshape(-1, 3)  # each face has vertices of its own
    apart = np.concatenate([faces, faces + 5.0, faces - 5.0])
    trimesh.Trimesh(apart, np.arange(len(apart)).reshape(-1, 3), process=False).export(tmp_path / "balls.glb")
    assert real.count_pieces(tmp_path / "balls.glb") == 3
