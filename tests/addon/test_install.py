"""Test that the add-on installs and removes the trainer. A fake stands in for the package installer uv."""

import json
import os
import signal
import sys
import tomllib
from pathlib import Path

import pytest

from refgs_addon import jobs
from refgs_addon.trainer import commands, installation
from tests.makers.bring import bring
from tests.makers.waiting import final_state, until

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="the fake uv is a script that Windows does not start")
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def home(tmp_path, monkeypatch):
    """Set up a fake installer, and return the folder that the trainer will be installed into.

    The fake installer is a script named uv, and the trainer's package is empty.
    """
    monkeypatch.setattr(installation, "WHEELS", bring(tmp_path))
    yield tmp_path / "user" / "trainer"
    jobs.stop_all()


def install(home):
    return commands.install(home, home.parent / "logs" / "installation.txt")


@pytest.fixture
def hanging(home, monkeypatch):
    """Start an installation that hangs during its download; return its job."""
    monkeypatch.setenv("FAKE_UV", "hang")
    job = install(home)
    until(lambda: job.fraction > 0)
    return job


def ended(job):
    """Wait until a job and its process have ended. Return the job's state and its last message."""
    state = final_state(job)
    job._process.wait(timeout=20)
    return state, job.line


def calls(home):
    return [json.loads(line) for line in (home.parent / "uv calls").read_text().splitlines()]


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return "(zombie)" not in Path(f"/proc/{pid}/status").read_text() if Path("/proc").is_dir() else True


def test_an_installation_to_its_end(home, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "/nowhere")
    monkeypatch.setenv("UV_DEFAULT_INDEX", "mirror")
    assert installation.bundled_version() == "9.9"
    assert not installation.installed(home) and not installation.interrupted(home)
    job = install(home)
    assert ended(job)[0] == "done" and job.ready["refgs"] == "9.9"
    assert installation.installed(home) == "9.9" and installation.python(home).is_file()
    until(lambda: not (home / "cache").exists())
    assert not (home / "uv").exists() and not installation.interrupted(home)
    make, fill = calls(home)
    assert make["words"][-4:] == ["venv", "--python", installation.PYTHONS, str(home / "env")]
    assert fill["words"][-1].endswith("refgs-9.9-py3-none-any.whl[farm]") and "--no-build" in fill["words"]
    variables = fill["variables"]
    assert variables["UV_DEFAULT_INDEX"] == "mirror" and variables["UV_TORCH_BACKEND"] == "auto"
    assert variables["UV_PYTHON_PREFERENCE"] == "only-managed" and "PYTHONPATH" not in variables
    assert "torch==2.14.0" in job.log.read_text()
    asked = commands.query_trainer(installation.python(home), home.parent / "logs" / "trainer.txt")
    assert ended(asked)[0] == "done"


def test_what_the_studio_has_set_stays(home, monkeypatch):
    monkeypatch.setenv("UV_TORCH_BACKEND", "")
    monkeypatch.setenv("UV_NO_MANAGED_PYTHON", "1")
    ended(install(home))
    variables = calls(home)[-1]["variables"]
    assert "UV_TORCH_BACKEND" not in variables and "UV_PYTHON_PREFERENCE" not in variables


def test_progress_stopping_and_going_on(home, hanging, monkeypatch):
    assert hanging.line.startswith("Fetching torch (850.5MiB) and 1 more: 0.1 of about ")
    assert 0.005 < hanging.fraction < 0.03
    hanging.stop()
    assert ended(hanging) == ("cancelled", "Stopped")
    until(lambda: not alive(calls(home)[-1]["pid"]))
    assert installation.interrupted(home) and not installation.installed(home) and (home / "cache" / "torch").exists()
    monkeypatch.delenv("FAKE_UV")
    half = home / "env" / "half"
    half.touch()
    assert ended(install(home))[0] == "done" and installation.installed(home) == "9.9" and not half.exists()


def test_two_blenders_do_not_install_at_once(home, hanging):
    for second in (install(home), commands.remove(home, home.parent / "logs" / "removal.txt")):
        state, line = ended(second)
        assert state == "failed" and line.startswith("another Blender installs or removes the trainer")
    assert not hanging.ended and (home / "cache" / "torch").exists()


@pytest.mark.parametrize("how", ["Blender", "the process"])
def test_killed_in_the_middle(home, hanging, monkeypatch, how):
    if how == "Blender":  # the process notices the end of its input
        hanging._process.stdin.close()
    else:
        hanging._process.send_signal(signal.SIGKILL)
    state, line = ended(hanging)
    assert state == "failed" and "see its log" in line
    uv = calls(home)[-1]["pid"]
    if how == "Blender":
        until(lambda: not alive(uv))
    else:
        os.kill(uv, signal.SIGKILL)
    assert installation.interrupted(home)
    monkeypatch.delenv("FAKE_UV")
    assert ended(install(home))[0] == "done"


@pytest.mark.parametrize(
    "fate, line",
    [
        ("network", "wheels.example cannot be reached: check the connection and the firewall, and resume"),
        ("full", "the disk of {home} is full: free some space and resume"),
        ("mute", "the trainer is installed but does not start on this machine: see the log"),
    ],
)
def test_what_fails_is_said_in_one_line(home, monkeypatch, fate, line):
    monkeypatch.setenv("FAKE_UV", fate)
    job = install(home)
    assert ended(job) == ("failed", line.format(home=home)) and job.log.stat().st_size > 0
    assert installation.interrupted(home)


def test_what_else_uv_may_say():
    explain = installation.explain_uv_error
    unsolved = "error: No solution found when resolving\n cause: torch"
    assert "does not exist for this machine" in explain(unsolved, "/a")
    assert explain("error: Access is denied. (os error 5)", "/a").startswith("cannot write to /a")
    assert explain("error: something else", "/a") == ""


def test_a_newer_release_goes_into_what_is_there(home, tmp_path, monkeypatch):
    ended(install(home))
    kept = home / "env" / "torch"
    kept.touch()
    monkeypatch.setattr(installation, "WHEELS", bring(tmp_path, "9.10"))
    assert installation.installed(home) == "9.9" and installation.bundled_version() == "9.10"
    assert ended(install(home))[0] == "done" and installation.installed(home) == "9.10" and kept.exists()


def test_removing(home):
    ended(install(home))
    job = commands.remove(home, home.parent / "logs" / "installation.txt")
    assert ended(job)[0] == "done" and not home.exists() and not installation.installed(home)
    assert ended(commands.remove(home, job.log))[0] == "done"


def test_a_disk_that_is_too_full(home, monkeypatch):
    assert installation.free_bytes(home) > 0  # the folder does not exist yet: its parent's disk counts
    monkeypatch.setattr(installation, "free_bytes", lambda home: 1.2e9)
    monkeypatch.setattr(installation.shutil, "which", lambda name: None)
    said = installation.disk_full_line(home)
    assert str(home) in said and "it needs about 2 GB; 1 GB are free" in said
    monkeypatch.setattr(installation, "folder_bytes", lambda folder: 1e9)  # half is downloaded already
    assert installation.disk_full_line(home) == ""
    monkeypatch.setattr(installation.shutil, "which", lambda name: f"/bin/{name}")
    assert "it needs about 7 GB" in installation.disk_full_line(home)


def test_a_clone_brings_no_trainer(monkeypatch, tmp_path):
    monkeypatch.setattr(installation, "WHEELS", tmp_path)
    assert installation.bundled_version() == ""


def test_the_pythons_are_those_of_the_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["requires-python"] == installation.PYTHONS
