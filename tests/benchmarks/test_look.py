"""Test the comparison of Blender's pictures with true ones, on a run that is the truth."""

import shutil

import cv2
import numpy as np
import pytest

from benchmarks import look
from benchmarks.harness import read
from benchmarks.look_in_blender import DRAWN
from refgs.capture import read_capture
from refgs.compare.pictures import maps
from refgs.formats.exr import write_exr
from refgs.formats.panorama import directions
from refgs.run import open_run
from tests.makers.ball import TURN, dusk, write_run

pytest.importorskip("bpy", reason="needs Blender's Python module")


@pytest.fixture
def made(ball_capture, tmp_path):
    """Write a scene and a run of it. The true pictures are the run's own, so the renderer has no error."""
    scene, folder = tmp_path / "scenes" / "ball", tmp_path / "runs" / "ball"
    shutil.copytree(ball_capture, scene, ignore=shutil.ignore_patterns("ground_truth"))
    capture = read_capture(scene)
    write_run(folder, capture)
    (folder / "mesh.glb").unlink()  # it shows a box; the benchmark makes one of the ball
    run, truth = open_run(folder), scene / "ground_truth"
    for name in ("color", "alpha", "relight/dusk"):
        (truth / name).mkdir(parents=True)
    panorama = dusk(directions(64, 128)).astype(np.float32)
    write_exr(truth / "relight" / "dusk.exr", dusk(directions(64, 128) @ TURN).astype(np.float32))
    for view in capture.test_views:
        images = maps(run.render(view.camera))
        images["relight/dusk"] = maps(run.render(view.camera, run.light(panorama)))["color"]
        for name in ("color", "alpha", "relight/dusk"):
            write_exr(truth / name / f"{view.camera.name}.exr", images[name])
    return scene.parent, folder.parent


@pytest.mark.slow
def test_a_run_that_is_the_truth(made, tmp_path, monkeypatch):
    monkeypatch.setattr(look, "VIEWS", 1)  # Eevee in software takes seconds a picture
    scenes, runs = made
    words = ["--scenes", scenes, "--runs", runs, "--out", tmp_path / "out", "--csv", tmp_path / "a.csv"]
    look.main([str(word) for word in words])
    found = {(row.variant, row.figure): row.value for row in read(tmp_path / "a.csv")}
    for light in ("recovered", "other"):
        errors = {drawn: found[drawn, f"{light}_psnr_aligned"] for drawn in (look.RENDERER, *DRAWN)}
        assert errors.pop(look.RENDERER) > 45, light
        assert all(17 < error < 45 for error in errors.values()), (light, errors)
        assert found[look.RENDERER, f"{light}_specks"] == 0
    assert all(found[drawn, "milliseconds"] > 0 for drawn in DRAWN)
    height, width = cv2.imread(str(tmp_path / "out" / "ball.png")).shape[:2]
    assert (height, width) == (2 * look.VIEWS * 32, 5 * 32)
