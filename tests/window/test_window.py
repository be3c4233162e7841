"""Test the extension in a real Blender window: build, install, show its tab, train, and close Blender.

Set REFGS_BLENDER to the command of a Blender that can open a window. By default this is `blender` from the PATH, and xvfb-run gives it
a display if DISPLAY is not set.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from refgs.formats.gltf import write_glb
from refgs_addon import jobs
from tests.makers.box import textured_box
from tests.makers.films import film_ball
from tests.makers.still_life import PHOTOS, add_mesh_light_and_photos, write_still_life
from tests.makers.training import TINY

HIGHLIGHT = 84, 115, 200  # BGR, about
ROOT = Path(__file__).resolve().parents[2]


def blender_command():
    """Find the command that opens a Blender window, or skip the test with the reason."""
    if "REFGS_BLENDER" in os.environ:
        return shlex.split(os.environ["REFGS_BLENDER"])
    if not shutil.which("blender"):
        pytest.skip("no Blender window: no `blender` in the PATH, and REFGS_BLENDER is not set")
    version = subprocess.run(["blender", "--version"], capture_output=True, text=True).stdout
    numbers = tuple(map(int, re.search(r"Blender (\d+)\.(\d+)", version).groups()))
    if numbers < (4, 3):
        pytest.skip(f"no Blender window: `blender` is {numbers[0]}.{numbers[1]}, and the extension needs 4.3")
    if os.environ.get("DISPLAY") or sys.platform in ("win32", "darwin"):
        return ["blender"]
    if not shutil.which("xvfb-run"):
        pytest.skip("no Blender window: neither a DISPLAY nor xvfb-run")
    return ["xvfb-run", "-a", "-s", "-screen 0 1600x1000x24", "blender", "-p", "0", "0", "1600", "1000"]


def covered(file, color):
    """Return the part of a screenshot's pixels that nearly have a colour (BGR)."""
    return float((np.abs(cv2.imread(str(file)).astype(int) - color).max(axis=2) < 60).mean())


def golden(file):
    """Return the part of a screenshot's pixels that are yellow: far more red than blue, and green between."""
    blue, green, red = np.moveaxis(cv2.imread(str(file)).astype(int), 2, 0)
    return float(((red > blue + 40) & (green > blue + 15) & (red > green)).mean())


def in_window(script, tmp_path, *words, simulated=True):
    """Build the extensions and a repository with them, and run a script with it in a Blender window. Returns the script's report.

    `words` are further arguments of the script. With `simulated`, the window takes events from the script, and none from the mouse.
    """
    command = blender_command()
    bpy = pytest.importorskip("bpy", reason="the extension is built with the tool in Blender's Python module")
    tool = Path(bpy.utils.resource_path("LOCAL"), "scripts", "addons_core", "bl_pkg", "cli", "blender_ext.py")
    repository = tmp_path / "repository"
    subprocess.run([sys.executable, ROOT / "scripts" / "build_extension.py", repository, "--bare"], check=True)
    subprocess.run([sys.executable, tool, "server-generate", "--repo-dir", repository], check=True)
    folder = Path(__file__).parent
    beside = ["--python-expr", f"import sys; sys.path.append({str(folder)!r})", "--python", folder / script]
    events = ["--enable-event-simulate"] if simulated else []
    words = [*command, *events, *beside, "--", repository, *words, tmp_path]
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "user")}
    done = subprocess.run(list(map(str, words)), env=environment, capture_output=True, text=True, timeout=1200)
    path = tmp_path / "report.json"
    assert path.exists(), done.stdout[-3000:] + done.stderr[-3000:]
    report = json.loads(path.read_text())
    assert "error" not in report, report["error"]
    return report


@pytest.mark.window
def test_the_tab_shows_in_a_window(tmp_path):
    run = write_still_life(tmp_path / "still")
    add_mesh_light_and_photos(run)
    write_glb(run / "mesh.glb", *textured_box())
    report = in_window("drive.py", tmp_path, run)
    assert report["enabled"] == [True, False]
    assert report["drawn"] == [f"REFGS_PT_{name}" for name in ("light", "materials", "preview", "run")]
    assert "REFGS_PT_train" in report["drawn with the trainer"]
    if report["numpy"]:
        assert report["import"] == ["FINISHED"]
        for name in ("splats.ply", "mesh.glb", "light.exr", "preview.png"):
            assert (tmp_path / name).stat().st_size > 0
        assert "mesh.glb" in report["wrote"] and report["render"] == ["done", ""]
    else:
        assert "Blender's Python lacks numpy" in report["import"]
    assert report["trainer alone"] == ["REFGS_PT_no_trainer"] and report["enabled again"] and report["left"] == []
    for name in ("alone", "both", "trainer alone"):
        picture = cv2.imread(str(tmp_path / f"{name}.png"))
        assert picture.shape[0] > 500 and picture.shape[1] > 800 and picture.std() > 5


@pytest.mark.window
@pytest.mark.timeout(1200)  # a look for each button takes seconds
def test_first_clicks(tmp_path, python):
    """Check the first ten minutes by real clicks and by what the window shows: from an empty file to a relit picture."""
    run = write_still_life(tmp_path / "still", doubt=0.0)
    add_mesh_light_and_photos(run)
    points = json.dumps(
        {"questions": [{"part": 0.5, "now": "metal", "picture": "1.png", "points": [[0, -1, 0], [1, 0, 0]]}]}
    )
    (run / "questions.json").write_text(points)
    report = in_window("clicks.py", tmp_path, python, run, simulated=False)
    if not report["xdotool"]:
        pytest.skip("no xdotool, which clicks as an artist does")
    assert report["left"] == 0 and report["imported"] == "MATERIAL"
    assert Path(report["light"]).stem == "sunrise" and Path(report["relit"]).stem == "sunset"
    for name in ("left", "right"):
        assert covered(tmp_path / f"{name}.png", PHOTOS[name]) > 0.05 > covered(tmp_path / "no photo.png", PHOTOS[name])
    assert report["perspective"] == "PERSP"
    for where, (shading, active) in report["edited"].items():
        assert shading == "MATERIAL" and active == f"{where} of still splats"
        assert golden(tmp_path / f"{where}.png") > 0.01
    assert report["painting"] == "PAINT_WEIGHT"
    for part in ("splats", "mesh"):
        assert golden(tmp_path / f"painted {part}.png") > 0.05
    nothing, orange, one = [0, 0, False], [0, 0, True], [1, 1, False]
    assert report["begun"] == {
        "hovering": orange, "hovered": nothing, "asking": orange, "asked": nothing, "agreed": one, "answered": one,
    }  # fmt: skip
    for name in ("hovered", "asked"):
        assert covered(tmp_path / f"{name}.png", HIGHLIGHT) > 0.02 > covered(tmp_path / "cancelled.png", HIGHLIGHT)
    assert report["hinted"] == ["done", "still 2"] and not (tmp_path / "still 3").exists()
    assert report["edit"] == "Copper, sphere"
    assert report["picture"] == ["done", ""]
    picture = cv2.imread(str(tmp_path / "relit ball.png")).astype(int)
    warmth = picture[..., 2] - picture[..., 0]
    assert warmth.max() > 30 and warmth.min() < -15  # copper and sky, where ball and light were grey


@pytest.mark.window
@pytest.mark.timeout(1200)
def test_one_click_imports_the_example(tmp_path):
    report = in_window("example.py", tmp_path, simulated=False)
    if not report["xdotool"]:
        pytest.skip("no xdotool, which clicks as an artist does")
    assert report["active"] == "jar mesh" and report["shading"] == "MATERIAL"
    assert golden(tmp_path / "example.png") > golden(tmp_path / "empty.png") + 0.02


@pytest.mark.window
def test_an_artist_trains(tmp_path, ball_capture):
    """Check a whole session in a Blender window with the real trainer.

    The session checks and trains a capture, shows live surfels, pauses, stops, resumes, finishes and imports the run. Then it compares
    with a photo, relights, edits, applies the edits, renders in another Blender, and clicks on a part for a hint.
    """
    capture = tmp_path / "ball photos"
    shutil.copytree(ball_capture, capture)
    report = in_window("train.py", tmp_path, sys.executable, capture)
    assert any("28, 24 to train on" in line for line in report["checked"])
    assert report["stopped"] > 0
    states = {name: jobs[-1][1] for name, jobs in report["steps"].items() if jobs}
    assert states == {
        "checked": "done", "cameras": "done", "training": "running", "paused": "paused", "stopped": "cancelled",
        "resumed": "running", "done": "done", "imported": "done",
    } | dict.fromkeys(states.keys() & {"photo", "relit", "edited", "applied"}, "done") | (
        {"live": "running", "previewed": "done", "hinted": "running"} if report["imported"] == ["FINISHED"] else {}
    )  # fmt: skip
    run = Path(report["run"])
    assert run == tmp_path / "ball photos RefGS" and (run / "splats.ply").exists() and (run / "mesh.glb").exists()
    assert report["imported"] == ["FINISHED"] or "Blender's Python lacks numpy" in report["imported"]
    if report["imported"] == ["FINISHED"]:
        assert report["left"] == []  # the live surfels are removed
        assert {"splats.ply", "mesh.glb", "textures", "environment.exr"} <= set(report["applied"])
        assert report["preview"] == ["done", ""] and cv2.imread(str(tmp_path / "preview.png")).std() > 5
    for name in report["steps"]:
        assert cv2.imread(str(tmp_path / f"{name}.png")).std() > 5
    assert report["cameras"] == 28
    print("longest that the window was busy, in seconds:", report["longest"])
    print("of that for the add-on's timer and panels:", report["ours"])
    print("what buttons took:", report["clicks"])


@pytest.mark.window
def test_a_film_becomes_a_run(tmp_path):
    """Check the way from a film to an imported run with the real trainer: photos, cameras, masks, a painted stroke, training."""
    film_ball(tmp_path / "ball.mp4")
    report = in_window("film.py", tmp_path, sys.executable, tmp_path / "ball.mp4")
    assert report["capture"] == str(tmp_path / "ball") and report["line"] == ""
    assert report["placed"] == report["masks"] == report["cameras"] == 24
    assert min(report["box"]) > 0.5 and max(report["box"]) < 2
    if not report["numpy"]:
        pytest.skip("Blender's Python lacks numpy: strokes cannot be painted")
    assert report["editor"][0] == "PAINT"
    strokes = cv2.imread(report["strokes"], cv2.IMREAD_UNCHANGED)
    drawn = strokes[..., 3] > 0
    assert 0.001 < drawn.mean() < 0.2 and not strokes[drawn, :3].any()
    mask = cv2.imread(str(tmp_path / "ball" / "masks" / Path(report["strokes"]).name), cv2.IMREAD_GRAYSCALE)
    assert (mask[drawn] > 127).mean() < 0.1 and (mask > 127).mean() > 0.02
    assert report["corrected"] == report["trained"] == "done" and report["imported"] == ["FINISHED"]


@pytest.mark.window
def test_an_artist_trains_many(tmp_path, ball_capture):
    """Check Train Many with the real trainer: the table while captures are trained, a run that fails, and the library of assets."""
    for name in ("ball", "a museum piece with a long name", "broken"):
        shutil.copytree(ball_capture, tmp_path / "shelf" / name)
    next((tmp_path / "shelf" / "broken").rglob("*.png")).write_bytes(b"no picture")
    changes = [*TINY, "environment.resolution=16", "train.iterations=400", "mesh.resolution=32", "mesh.texture=64"]
    captures = "".join(f'[[captures]]\nfolder = "{folder}"\n' for folder in sorted((tmp_path / "shelf").iterdir()))
    (tmp_path / "list.toml").write_text(f"set = {json.dumps(changes)}\n{captures}")
    results = tmp_path / "results"
    report = in_window("many.py", tmp_path, sys.executable, tmp_path / "list.toml", results)
    assert {name: state for name, state, _ in report["running"]}.keys() == {
        file.name for file in (tmp_path / "shelf").iterdir()
    }
    assert report["ended"] == ["done", ""]
    states = {name: state for name, state, _ in report["rows"]}
    assert states == {"ball": "done", "a museum piece with a long name": "done", "broken": "failed"}
    for name in ("running", "failed", "assets"):
        assert cv2.imread(str(tmp_path / f"{name}.png")).std() > 5
    if not report["numpy"]:
        assert report["assets"][0] == "failed" and "lacks numpy" in report["assets"][1]
        return
    assert report["assets"] == ["done", ""] and str(results / "library") in report["libraries"]
    files = {file.name for file in (results / "library").iterdir()}
    assert files == {"ball.blend", "a museum piece with a long name.blend", "blender_assets.cats.txt"}


@pytest.mark.window
@pytest.mark.parametrize("letter", ["S", "L"])
def test_closing_asks(tmp_path, ball_capture, letter):
    """Check that Ctrl-Q asks about a running training, and that the answers Cancel, Stop Cleanly and Leave Running do what they say."""
    capture = tmp_path / "photos"
    shutil.copytree(ball_capture, capture)
    report = in_window("close.py", tmp_path, sys.executable, capture, letter)
    assert report["states"] == ["running"]  # after Cancel
    run = Path(report["run"])
    while jobs.run_state(run) == "training":  # after Stop Cleanly, until the checkpoint is written
        time.sleep(1)
    if letter == "S":
        assert jobs.run_state(run) == "stopped"
    else:
        assert (run / "splats.ply").exists() and (run / "mesh.glb").exists()
