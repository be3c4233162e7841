"""Test the preferences' buttons: install, stop, resume, use and remove the trainer. A fake stands in for uv."""

import sys

import bpy
import pytest

from refgs_addon import jobs
from refgs_addon.errors import InputError
from refgs_addon.trainer import commands, installation, preferences
from tests.makers import extension
from tests.makers.bring import bring
from tests.makers.waiting import final_state, until

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="the fake uv is a script that Windows does not start")


@pytest.fixture
def online(addon, tmp_path, monkeypatch):
    """Allow online access in Blender, and give the add-on a fake installer and an empty user folder."""
    monkeypatch.setattr(installation, "WHEELS", bring(tmp_path))
    monkeypatch.setattr(preferences, "_folder", lambda name: tmp_path / name)
    bpy.context.preferences.system.use_online_access = True


@pytest.fixture
def hanging(online, monkeypatch):
    """Start an installation that hangs during its download; return its job."""
    monkeypatch.setenv("FAKE_UV", "hang")
    bpy.ops.refgs.install_trainer()
    job = preferences.installing()
    until(lambda: job.fraction > 0)
    return job


def test_installed_used_and_removed(online):
    assert "not set up" in preferences.status()[1] and not preferences.set_up()
    assert bpy.ops.refgs.install_trainer() == {"FINISHED"}
    assert preferences.status() == ("SORTTIME", "The trainer is being installed")
    assert not bpy.ops.refgs.install_trainer.poll()
    assert final_state(preferences.installing()) == "done"
    assert preferences.status() == ("CHECKMARK", "RefGS 9.9, training on the processor: it is a fake")
    assert preferences.set_up() and preferences.python() == installation.python(preferences.home())
    bpy.ops.refgs.ask_trainer()
    until(lambda: preferences.own_jobs()[0].ended)
    assert preferences.status()[0] == "CHECKMARK"
    assert bpy.ops.refgs.remove_trainer() == {"FINISHED"}
    until(lambda: not preferences.installing())
    assert "not set up" in preferences.status()[1] and not preferences.home().exists()


def test_stopped_and_gone_on_with(hanging, monkeypatch):
    bpy.ops.refgs.stop_installing()
    assert final_state(hanging) == "cancelled" and installation.interrupted(preferences.home())
    assert "not set up" in preferences.status()[1]
    monkeypatch.setenv("FAKE_UV", "network")
    bpy.ops.refgs.install_trainer()
    until(lambda: not preferences.installing())
    assert preferences.status()[0] == "ERROR" and "Wheels.example cannot be reached" in preferences.status()[1]
    monkeypatch.delenv("FAKE_UV")
    bpy.ops.refgs.install_trainer()
    until(lambda: not preferences.installing())
    assert preferences.status()[0] == "CHECKMARK"


def test_why_it_cannot_be_installed(online, python, monkeypatch, tmp_path):
    poll = bpy.ops.refgs.install_trainer.poll
    assert poll() and not preferences.installation_problem()
    bpy.context.preferences.system.use_online_access = False
    assert not poll() and "allow online access" in preferences.installation_problem()
    bpy.context.preferences.system.use_online_access = True
    preferences.preferences().python = str(python)
    assert not poll() and "A Python is chosen" in preferences.installation_problem()
    preferences.preferences().python = ""
    (tmp_path / "photos").mkdir()
    commands.train(python, commands.Asked(tmp_path / "photos", tmp_path / "run"), tmp_path / "log.txt")
    assert not poll() and "trainer is running" in preferences.installation_problem()
    with pytest.raises(InputError, match="trainer is running"):
        preferences.remove()
    jobs.stop_all()
    monkeypatch.setattr(installation, "free_bytes", lambda home: 1e9)
    with pytest.raises(RuntimeError, match=r"too little space .*\(it needs about"):
        bpy.ops.refgs.install_trainer()
    monkeypatch.setattr(installation, "WHEELS", tmp_path)
    assert not poll() and "contains no trainer" in preferences.installation_problem()


def test_taken_away_while_it_installs(hanging):
    extension.disable()
    assert hanging._process.wait(timeout=20) == 1 and not installation.installed(preferences.home())
    extension.enable()
