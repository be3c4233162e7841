"""Test rendering in a second Blender process. It renders the open file with its unsaved changes, or reports one line of error."""

import time

import bpy
import numpy as np
import pytest
from PIL import Image

from refgs_addon import jobs
from refgs_addon.errors import InputError
from refgs_addon.scene.import_run import import_run
from refgs_addon.scene.render_process import render_in_background
from tests.makers.runs import write_panorama
from tests.makers.waiting import final_state, until


@pytest.fixture(autouse=True)
def no_jobs_are_left():
    yield
    jobs.stop_all()


def test_a_preview_and_a_sheet_of_the_file_as_it_is(run, scene, tmp_path):
    write_panorama(tmp_path / "red.exr", np.broadcast_to((1, 0.05, 0.05), (8, 16, 3)))
    scene.eevee.use_raytracing = False  # much faster in software
    folder = tmp_path / "été 'a'"
    folder.mkdir()
    alone = render_in_background(scene, folder / "a.png", size=24, samples=2)
    sheet = render_in_background(scene, folder / "b.png", [tmp_path / "red.exr"], size=24, samples=2)
    until(lambda: alone.ended and sheet.ended, 120)
    assert (alone.state, sheet.state) == ("done", "done"), (alone.line, sheet.line)
    assert alone.results["render"]["png"] == str(folder / "a.png")
    assert [Image.open(folder / name).size for name in ("a.png", "b.png")] == [(24, 24), (24, 52)]
    assert sheet.fraction == 1 and not bpy.data.filepath


def test_what_cannot_be_rendered_is_said_in_one_line(run_folder, scene, tmp_path):
    with pytest.raises(InputError, match="no camera"):
        render_in_background(scene, tmp_path / "a.png")
    import_run(run_folder, scene)
    with pytest.raises(InputError, match="its folder does not exist"):
        render_in_background(scene, tmp_path / "not there" / "a.png")
    job = render_in_background(scene, tmp_path / "a.png", [tmp_path / "missing.exr"], size=8, samples=1)
    assert final_state(job, 120) == "failed" and "cannot read the light" in job.line


def test_it_ends_when_it_is_put_away(run, scene, tmp_path):
    job = render_in_background(scene, tmp_path / "a.png", size=2000, samples=4096)
    until(lambda: job.state == "running", 120)
    time.sleep(0.2)
    job.stop()
    assert final_state(job, 60) == "cancelled" and not (tmp_path / "a.png").exists()
