"""Test training from Blender with a fake trainer: the scene's settings, the buttons, and the runs that the Blender file lists."""

import json
import math
import shutil
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import bpy
import numpy as np
import pytest
from filelock import FileLock
from scipy.spatial.transform import Rotation

from refgs_addon import jobs
from refgs_addon.blend_paths import check_own
from refgs_addon.errors import InputError
from refgs_addon.ply_file import read_rows
from refgs_addon.scene.camera_objects import photo_shown
from refgs_addon.scene.capture_cameras import cameras_of
from refgs_addon.scene.find_run import find_run
from refgs_addon.scene.import_run import import_run
from refgs_addon.trainer import commands, preferences, timers
from refgs_addon.trainer.scene import training, training_box
from refgs_addon.trainer.ui import checked_capture, train_panel
from refgs_addon.trainer.ui.closing import quit_question
from refgs_addon.trainer.ui.job_icons import CURVE, DOTS, GRID, LINE, plot
from tests.makers import extension
from tests.makers.captures import edit
from tests.makers.waiting import final_state, until

pytestmark = pytest.mark.usefixtures("fake_trainer")


@pytest.fixture
def capture(addon, tmp_path):
    folder = tmp_path / "good photos"
    folder.mkdir()
    addon.refgs.capture = f"{folder}/"
    return folder


def test_the_trainer_is_asked_when_it_is_chosen(addon):
    assert preferences.status()[1] == "Querying …"
    until(lambda: all(job.ended for job in jobs.JOBS))
    assert preferences.status() == ("CHECKMARK", "RefGS 9.9, training on the processor: it is a fake")
    preferences.preferences().python = "/no/python"
    assert preferences.status()[0] == "ERROR" and "cannot be started" in preferences.status()[1]
    preferences.preferences().python = ""
    assert "not set up" in preferences.status()[1]
    with pytest.raises(InputError, match="no trainer is set up"):
        preferences.python()


def test_the_buttons_train_and_the_file_remembers(addon, capture, tmp_path):
    addon.refgs.limited, addon.refgs.minutes, addon.refgs.mesh = True, 3.0, False
    assert bpy.ops.refgs.train() == {"FINISHED"}
    job, out = jobs.JOBS[-1], tmp_path / "good photos RefGS"
    assert job.run == out and addon.refgs.runs[0].folder == str(out)
    until(lambda: job.progress)
    bpy.ops.refgs.tell(serial=job.serial, command="pause")
    until(lambda: job.state == "paused")
    bpy.ops.refgs.tell(serial=job.serial, command="cancel")
    until(lambda: job.state == "cancelled")
    asked = json.loads((out / "started").read_text())
    assert asked["minutes"] == 3.0 and asked["preset"] is None  # the minutes choose everything
    bpy.ops.refgs.put_away(serial=job.serial)
    assert job not in jobs.JOBS
    # Saved and opened again, the file lists the run, which is resumed.
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    addon.refgs.runs.clear()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    scene = bpy.context.scene
    assert scene.refgs.runs[0].folder == str(out) and jobs.run_state(out) == "stopped"
    bpy.ops.refgs.resume(folder=str(out))
    assert final_state(jobs.JOBS[-1]) == "done" and jobs.run_state(out) == "finished"
    with pytest.raises(InputError, match="no stopped training"):
        training.resume(scene, out)
    training.forget(scene, out)
    assert not scene.refgs.runs and out.is_dir()


def stopped(scene):
    """Train with the fake trainer, and stop the training. Returns the run folder."""
    scene.refgs.mesh = False
    job = training.train(scene)
    until(lambda: job.progress)
    bpy.ops.refgs.tell(serial=job.serial, command="cancel")
    assert final_state(job) == "cancelled"
    return job.run


def test_a_copied_file_does_not_resume_the_originals_run(addon, capture, tmp_path):
    """Check a .blend that was copied without the run, to where its relative path leads to the same run."""
    first, second = (tmp_path / name / "a.blend" for name in ("first", "second"))
    first.parent.mkdir()
    run = stopped(addon)
    bpy.ops.wm.save_as_mainfile(filepath=str(first))
    shutil.copytree(first.parent, second.parent)
    for _ in range(2):  # the second time as it was saved
        bpy.ops.wm.open_mainfile(filepath=str(second))
        with pytest.raises(InputError, match=rf"belongs to {first}, of which this file is a copy: continue there"):
            training.resume(bpy.context.scene, run)
        bpy.ops.wm.save_mainfile()
    mine = shutil.copytree(run, tmp_path / "second" / "run")
    find_run(run, mine)
    training.resume(bpy.context.scene, mine)
    assert final_state(jobs.JOBS[-1]) == "done" and jobs.run_state(run) == "stopped"
    bpy.ops.wm.open_mainfile(filepath=str(first))
    training.resume(bpy.context.scene, run)
    assert final_state(jobs.JOBS[-1]) == "done"


def test_a_file_saved_elsewhere_still_resumes_its_run(addon, capture, tmp_path):
    run = stopped(addon)
    (tmp_path / "else").mkdir()
    for file in (tmp_path / "a.blend", tmp_path / "else" / "b.blend"):
        bpy.ops.wm.save_as_mainfile(filepath=str(file))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "c.blend"), copy=True)
    for file in (tmp_path / "c.blend", tmp_path / "else" / "b.blend"):
        bpy.ops.wm.open_mainfile(filepath=str(file))
        check_own(bpy.context.scene, run)
    training.resume(bpy.context.scene, run)
    assert final_state(jobs.JOBS[-1]) == "done"


class Buttons:
    """Stand in for a layout, and record the buttons that a panel draws: `drawn` has the name and the properties of each operator."""

    def __init__(self):
        self.drawn = []

    def operator(self, name, **_):
        self.drawn.append((name.removeprefix("refgs."), SimpleNamespace()))
        return self.drawn[-1][1]

    def panel(self, *_, **__):
        return self, None

    def __getattr__(self, name):
        return lambda *_, **__: self


def draw_train_panel(scene):
    """Draw the Train panel. Returns a function that clicks the first of its buttons that has a name and properties."""
    buttons = Buttons()
    context = Mock(**{"scene": scene, "region.width": 500, "preferences.system.ui_scale": 1.0})
    train_panel.TrainPanel.draw(Mock(layout=buttons), context)

    def click(name, **properties):
        drawn = [vars(button) for other, button in buttons.drawn if other == name]
        getattr(bpy.ops.refgs, name)(**next(button for button in drawn if properties.items() <= button.items()))

    return click


def test_a_click_reaches_the_job_that_was_drawn(addon, capture):
    """Check that a panel that was drawn before a job was dismissed acts on no other job, and on none once its own job is gone."""
    addon.refgs.mesh = False
    first, second, third = (training.train(addon) for _ in range(3))
    first.stop()
    until(lambda: second.progress)
    assert first.state == "cancelled" and third.state == "waiting"
    click = draw_train_panel(addon)
    click("put_away")
    assert first not in jobs.JOBS
    click("tell", command="cancel")
    assert final_state(second) == "cancelled" and not third.ended
    draw_train_panel(addon)("put_away")
    assert second not in jobs.JOBS and third in jobs.JOBS
    for button in ({"command": "cancel"}, {"command": "pause"}):
        with pytest.raises(RuntimeError, match="no longer in the list: nothing was done"):
            click("tell", **button)
    assert final_state(third) == "done"


def test_what_is_to_be_learned(addon, capture):
    assert settings_sent(training.train(addon).run) == {}
    settings = addon.refgs
    settings.splats, settings.light, settings.exposures, settings.reflections = 5000, "camera", "off", "off"
    job = training.train(addon)
    changes = {"surfels.budget": 5000, "light.frame": "camera", "light.exposure": "off", "needs.reflections": "off"}
    assert settings_sent(job.run) == changes
    until(lambda: job.progress)
    # A line that is a detail is for the run's log alone.
    assert job.decided == {"light": "the light stands still: it brightens so"}


def test_runs_go_into_new_folders(addon, capture, tmp_path):
    (tmp_path / "good photos RefGS").mkdir()
    names = [training.train(addon).run.name for _ in range(2)]
    assert names == ["good photos RefGS 2", "good photos RefGS 3"]
    addon.refgs.out = str(capture)
    (capture / "a.png").touch()
    with pytest.raises(InputError, match="is not empty"):
        training.train(addon)


def test_the_buttons_wait_for_what_they_need(addon, capture):
    assert bpy.ops.refgs.train.poll() and bpy.ops.refgs.check_capture.poll()
    with bpy.context.temp_override(scene=bpy.data.scenes.new("empty")):
        assert not bpy.ops.refgs.train.poll()
    preferences.preferences().python = ""
    assert not bpy.ops.refgs.check_capture.poll()
    with pytest.raises(RuntimeError, match="Set up the trainer"):
        bpy.ops.refgs.train()


def test_a_capture_that_is_not_there(addon):
    with pytest.raises(InputError, match="no capture is chosen"):
        training.check(addon)
    addon.refgs.capture = "/nowhere"
    with pytest.raises(InputError, match="/nowhere is not a folder"):
        training.check(addon)


@pytest.fixture
def checked(addon, capture):
    """Run the check of the capture, with the fake trainer. Returns the job of this check."""
    job = training.check(addon)
    assert final_state(job) == "done"
    for number in range(2):
        shutil.copy(job.results["check"]["thumbnails"][number], capture / f"{number}.png")
    return job


def test_the_curve_in_the_panel():
    """Check that the panel draws PSNR over log time: a line for training views, and dots for held-out views."""
    width, height = CURVE
    seconds = np.geomspace(0.5, 200, 60)
    trained = [(s, 20 + 5 * np.log10(s)) for s in seconds]
    drawn = plot(trained, [(seconds[30], trained[30][1])])
    assert drawn.shape == (height, width, 4)
    line = (drawn == np.float32(LINE)).all(axis=2)
    rows, columns = np.nonzero(line)
    assert columns.max() - columns.min() > 0.9 * width and rows.max() - rows.min() > 0.9 * height
    straight = np.polyval(np.polyfit(columns, rows, 1), columns)
    assert np.abs(rows - straight).max() < 4
    dots = np.argwhere((drawn == np.float32(DOTS)).all(axis=2))
    assert len(dots) == 49 and np.abs(dots.mean(axis=0) - [rows.mean(), columns.mean()]).max() < 4
    decades = np.flatnonzero((drawn[0] == np.float32(GRID)).all(axis=1))
    assert len(decades) == 3 and abs(np.diff(decades)).max() - abs(np.diff(decades)).min() <= 1, "1, 10 and 100 seconds"
    flat = plot([(1.0, 20.0), (2.0, 20.0)], [])
    assert np.isfinite(flat).all() and (flat == np.float32(LINE)).all(axis=2).any()


def test_a_checked_capture_is_shown(addon, checked, capture, monkeypatch):
    layout, thumbnail = Mock(), Mock(side_effect=[1, 2, 1, 2])
    monkeypatch.setattr(checked_capture, "thumbnail", thumbnail)  # Blender has no icons without a window
    checked_capture.draw_capture(layout, addon, checked)
    drawn = layout.grid_flow.return_value.template_icon.call_args_list
    assert [icon.kwargs["icon_value"] for icon in drawn] == [1, 2]
    pictures = [(file.name, version) for (file, version), _ in thumbnail.call_args_list]
    assert pictures == [("0000.png", checked.serial), ("0001.png", checked.serial)]
    assert not layout.operator.call_args.kwargs["depress"]
    assert bpy.ops.refgs.show_cameras(serial=checked.serial) == {"FINISHED"}
    cameras = cameras_of(addon, capture)
    assert cameras.name == "good photos cameras" and [item.name for item in cameras.objects] == ["0", "1"]
    assert tuple(cameras.objects[1].matrix_world.translation) == (-4, 0, 0) and addon.camera == cameras.objects[0]
    assert bpy.ops.refgs.photo() == {"FINISHED"} and photo_shown(addon.camera) == 1
    assert bpy.ops.refgs.next_camera() == {"FINISHED"}
    assert addon.camera == cameras.objects[1] and photo_shown(addon.camera) == 1
    assert addon.camera.data.background_images[0].image.filepath == str(capture / "1.png")
    checked_capture.draw_capture(layout, addon, checked)
    assert layout.operator.call_args.kwargs["depress"]
    bpy.ops.refgs.show_cameras(serial=checked.serial)
    assert cameras_of(addon, capture) is None and not bpy.data.cameras and addon.camera is None
    assert not bpy.ops.refgs.next_camera.poll()


def test_a_run_brings_its_own_cameras(addon, checked, capture, run_folder):
    """Check that importing a run removes the cameras that were shown for its capture.

    The active camera becomes the run's camera of the same photo.
    """

    def rename(content):
        for frame, name in zip(content["frames"], ("1", "0"), strict=True):
            frame.update(file_path=f"images/{name}", photo=f"{name}.png")

    edit(run_folder / "cameras.json", rename)
    bpy.ops.refgs.show_cameras(serial=checked.serial)
    other = import_run(run_folder, addon)
    assert len(cameras_of(addon, capture).objects) == 2 and "1" not in [item.name for item in other.cameras.values()]
    addon.camera = cameras_of(addon, capture).objects[1]
    (run_folder / "run.toml").write_text(f"[run]\ncapture = {json.dumps(str(capture))}\n")
    run = import_run(run_folder, addon)
    assert cameras_of(addon, capture) is None and len(bpy.data.cameras) == 4
    assert addon.camera == run.cameras["1"]


def test_what_else_is_among_the_cameras_stays(addon, checked):
    bpy.ops.refgs.show_cameras(serial=checked.serial)
    lamp = bpy.data.objects.new("lamp", bpy.data.lights.new("lamp", "POINT"))
    cameras = next(item for item in addon.collection.children if item.name.endswith("cameras"))
    cameras.objects.link(lamp)
    bpy.ops.refgs.show_cameras(serial=checked.serial)
    assert not any(item.name.endswith("cameras") for item in bpy.data.collections)
    assert bpy.data.objects["lamp"] in list(addon.collection.objects) and not bpy.data.cameras


def test_photos_without_cameras(addon, tmp_path):
    (tmp_path / "bare photos").mkdir()
    addon.refgs.capture = str(tmp_path / "bare photos")
    checked = training.check(addon)
    assert final_state(checked) == "failed" and checked.no_cameras
    bpy.ops.refgs.find_cameras()
    assert checked not in jobs.JOBS
    assert final_state(jobs.JOBS[-1]) == "done" and "check" in jobs.JOBS[-1].results


def test_the_bar_shows_how_much_of_the_mesh_is_made(addon, capture, run_folder):
    for job in (training.train(addon), commands.export(preferences.python(), run_folder, run_folder / "log")):
        assert final_state(job) == "failed"  # as the fake does, after 40 % of the mesh
        assert (train_panel.fraction(job), train_panel.status_words(job)) == (0.4, "making the mesh, 40%")


def test_display_splats_are_made_by_the_trainer(addon, run_folder, tmp_path):
    bpy.ops.refgs.import_run(directory=f"{run_folder}/")
    (tmp_path / "a.ply").write_text("of before")
    bpy.ops.refgs.export_display_splats(filepath=str(tmp_path / "a.ply"))
    job = jobs.JOBS[-1]
    assert final_state(job) == "done" and job.results["export"]["display_splats"] == str(tmp_path / "a.ply")
    assert job.progress["stage"] == "colours" and (tmp_path / "a.ply").read_text() == str(run_folder)
    # The trainer gets the edits, and the run does not change.
    before = (run_folder / "splats.ply").read_bytes()
    bpy.ops.refgs.add_edit(where="Everywhere", material="Rubber")
    bpy.ops.refgs.export_display_splats(filepath=str(tmp_path / "a.ply"))
    until(lambda: jobs.JOBS[-1].ended)
    given = Path((tmp_path / "a.ply").read_text())
    assert given != run_folder and (given / "cameras.json").is_file()
    assert read_rows(given / "splats.ply")["roughness"] == pytest.approx(0.9)
    assert (run_folder / "splats.ply").read_bytes() == before
    with pytest.raises(RuntimeError, match="its folder does not exist"):
        bpy.ops.refgs.export_display_splats(filepath=str(tmp_path / "not there" / "a.ply"))
    preferences.preferences().python = ""
    assert not bpy.ops.refgs.export_display_splats.poll()
    with pytest.raises(InputError, match="no trainer is set up"):
        training.export_display_splats(bpy.data.collections["RefGS pot"], tmp_path / "b.ply")


def test_taken_away_while_it_trains(addon, capture):
    """Check that disabling the add-on ends its jobs."""
    training.train(addon)
    job = jobs.JOBS[-1]
    until(lambda: job.progress)
    extension.disable()
    assert job._process.wait(timeout=20) == 0 and not jobs.JOBS
    extension.enable()


def settings_sent(out):
    """Wait until the fake trainer has started in the run folder `out`. Returns the settings that it was given, by name."""
    until(lambda: (out / "started").is_file() and (out / "started").read_text())
    words = dict(word.split("=", 1) for word in json.loads((out / "started").read_text())["settings"])
    return {key: value if value.isalpha() else json.loads(value) for key, value in words.items()}


def test_a_box_is_the_region_and_its_up_the_results(addon, capture):
    assert bpy.ops.refgs.add_training_region() == {"FINISHED"}
    box = addon.refgs.region
    assert bpy.context.view_layer.objects.active == box and box.name in addon.objects
    assert bpy.ops.refgs.add_training_region() == {"FINISHED"} and len(addon.objects) == 1
    words = settings_sent(training.train(addon).run)
    assert words["region.centre"] == [0, 0, 0] and words["region.size"] == [2, 2, 2]
    assert words["region.rotation"] == [0, 0, 0] and words["region.up"] == [0, 0, 1]

    box.location, box.scale, box.empty_display_size = (1, 2, 3), (1, -2, 0.5), 0.5
    box.rotation_euler = [math.radians(angle) for angle in (90, 0, 90)]
    matrix = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])  # x to y, y to z, z to x
    words = settings_sent(training.train(addon).run)
    assert words["region.centre"] == [1, 2, 3]
    assert words["region.size"] == pytest.approx([1, 2, 0.5])
    found = Rotation.from_euler("xyz", words["region.rotation"], degrees=True).as_matrix()
    np.testing.assert_allclose(np.abs(found), matrix, atol=1e-6)  # axes, up to their signs
    assert words["region.up"] == pytest.approx([1, 0, 0], abs=1e-6)

    box.scale.x = 0
    with pytest.raises(InputError, match="RefGS Region is flat"):
        training.train(addon)
    bpy.data.objects.remove(box)
    assert addon.refgs.region is None and settings_sent(training.train(addon).run) == {}


UP = [("", (0, 0, 0), False), ("", (0, 0, 2), False), ("", (0, 0, -1), True), ("", (0, 0.1, 1), True)]


@pytest.mark.parametrize(("other", "up", "hidden"), [*UP, ("/another", (0, 1, 1), False)])
def test_a_box_is_not_shown_beside_its_captures_run_that_stands_otherwise(
    addon, capture, run_folder, other, up, hidden
):
    of = f"[run]\ncapture = {json.dumps(other or str(capture))}\n"
    (run_folder / "run.toml").write_text(f"{of}[settings.region]\nup = {list(up)}\n")
    bpy.ops.refgs.add_training_region()
    assert bpy.ops.refgs.import_run(directory=str(run_folder)) == {"FINISHED"}
    assert addon.refgs.region.hide_viewport == hidden
    bpy.ops.refgs.add_training_region()
    assert not addon.refgs.region.hide_viewport


def test_a_hidden_box_is_the_same_when_the_file_is_opened_again(addon, capture, tmp_path):
    bpy.ops.refgs.add_training_region()
    addon.refgs.region.location = 1, 2, 3
    addon.refgs.region.hide_viewport = True
    before = training_box.region_settings(addon)
    assert before["region.centre"] == [1, 2, 3] and addon.refgs.region.hide_viewport
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert training_box.region_settings(bpy.context.scene) == before


def test_a_box_that_is_deleted_or_cleared_is_no_region(addon, capture):
    bpy.ops.refgs.add_training_region()
    box = addon.refgs.region
    bpy.ops.object.delete()  # the settings still refer to it
    assert training_box.training_region(addon) is None and training_box.region_settings(addon) == {}
    bpy.ops.refgs.add_training_region()
    assert addon.refgs.region != box and training_box.region_settings(addon)
    addon.refgs.region = None
    assert training_box.region_settings(addon) == {}


def test_the_box_holds_what_the_cameras_look_at(addon, checked, capture):
    checked.results["check"] |= {"capture": str(capture.resolve()), "centre": [1.0, 2.0, 3.0], "radius": 4.0}
    box = training_box.add_training_region(addon)
    assert list(box.location) == [1, 2, 3] and list(box.scale) == [4, 4, 4]


def test_closing_asks_only_while_something_trains(addon, capture):
    assert not bpy.ops.refgs.quit.poll()
    first, second = training.train(addon), training.train(addon)
    until(lambda: first.progress)
    assert bpy.ops.refgs.quit.poll() and quit_question() == "2 trainings are running or waiting"
    bpy.ops.refgs.keep(serial=first.serial)
    assert first.kept and not second.kept
    bpy.ops.refgs.keep(serial=first.serial)
    assert not first.kept
    jobs.keep_all(True)
    assert first.kept and second.kept
    second.stop()
    assert quit_question() == "A training is running"
    # Blender disables its add-ons when it closes: kept jobs continue.
    extension.disable()
    assert not jobs.JOBS and first._process.wait(timeout=20) == 0
    assert jobs.run_state(first.run) == "finished" and not second.run.exists()
    extension.enable()


def test_a_run_that_another_process_trains(addon, capture, tmp_path):
    job = training.train(addon)
    until(lambda: job.progress)
    job.stop()
    assert final_state(job) == "cancelled"
    run = job.run
    jobs.JOBS.clear()
    with FileLock(run / "run.lock"):
        assert jobs.run_state(run) == "training" and timers._poll_other_processes() == timers.OTHER_SECONDS
        (run / "progress.json").write_text('{"iteration": 250, "total": 1000, "seconds_left": 190.0}')
        assert train_panel.other_process_status(run) == (0.25, "25%, 3:10 left")
        with pytest.raises(InputError, match="is being trained already"):
            training.resume(addon, run)
        bpy.ops.refgs.stop_run(folder=str(run))
        assert (run / "stop").exists() and train_panel.other_process_status(run)[1] == "Stopping"
        (run / "progress.json").unlink()
        (run / "splats.ply").touch()
        assert train_panel.other_process_status(run)[1] == "Making the mesh"
    assert jobs.run_state(run) == "finished" and timers._poll_other_processes() is None
    with pytest.raises(RuntimeError, match="is not being trained"):
        bpy.ops.refgs.stop_run(folder=str(run))


def test_the_guessed_box_is_among_the_cameras(addon, checked, capture):
    """Check that the cameras of a capture without masks are shown with the guessed box, which limits nothing until it is changed."""
    checked.results["check"] |= {"lines": ["Masks: none"], "centre": [0, 0, 1], "radius": 2.0}
    bpy.ops.refgs.show_cameras(serial=checked.serial)
    box = addon.refgs.region
    assert tuple(box.location) == (0, 0, 1) and tuple(box.scale) == (2.5, 2.5, 2.5)
    assert training_box.artists_region(addon) is None and training_box.region_settings(addon) == {}
    box.location.x = 1
    assert training_box.artists_region(addon) == box and training_box.region_settings(addon)["region.centre"] == [
        1,
        0,
        1,
    ]
    bpy.ops.refgs.show_cameras(serial=checked.serial)
    assert addon.refgs.region == box, "the artist's box stays"
    box.location.x = 0
    for _ in range(2):
        bpy.ops.refgs.show_cameras(serial=checked.serial)
    assert training_box.training_region(addon) is None, "an untouched guess goes with the cameras"
    bpy.ops.refgs.show_cameras(serial=checked.serial)
    bpy.ops.refgs.add_training_region()
    assert training_box.artists_region(addon) == addon.refgs.region
