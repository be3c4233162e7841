"""Test the zips that are released: what they contain, and that one installs a working trainer, which downloads gigabytes."""

import platform
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from refgs_addon.trainer import commands, installation
from tests.makers.waiting import final_state, until

pytest.importorskip("bpy", reason="the extension is built with the tool in Blender's Python module")
pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[1]
NAMES = {("Linux", "x86_64"): "linux_x64", ("Windows", "AMD64"): "windows_x64", ("Darwin", "arm64"): "macos_arm64"}


@pytest.fixture(scope="module")
def archives(tmp_path_factory):
    """Build and validate the zips of the trainer's extension for all platforms. Return their paths by platform."""
    out = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, ROOT / "scripts" / "build_extension.py", out], check=True)
    assert len(list(out.glob("refgs-*.zip"))) == 1
    return {archive.stem.split("-")[-1]: archive for archive in out.glob("refgs_trainer-*.zip")}


@pytest.fixture
def archive(archives):
    """Return the path of the zip for this platform."""
    name = NAMES.get((platform.system(), platform.machine()))
    if name is None:
        pytest.skip("there is no zip for this platform")
    return archives[name]


def test_locks_hold_what_the_trainer_needs_and_no_address(archives):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    needed = [*project["dependencies"], *extras["farm"], *extras["learned"]]
    pinned = {line.partition(";")[0].strip().lower() for line in needed}
    for archive in archives.values():
        lock = zipfile.ZipFile(archive).read("wheels/lock.txt").decode()
        lines = {line.partition(" ")[0] for line in lock.splitlines()}
        assert pinned <= lines
        assert not any(line.startswith(("opencv-python==", "torchvision==")) for line in lines)
        assert "://" not in lock


def test_the_zips(archives):
    code = {str(path.relative_to(ROOT / "refgs_addon")) for path in (ROOT / "refgs_addon" / "trainer").rglob("*.py")}
    code |= {path.name for path in (ROOT / "refgs_trainer").glob("*.py")}
    assert set(archives) == set(NAMES.values())
    for archive in archives.values():
        names = set(zipfile.ZipFile(archive).namelist())
        wheels = sorted(name.split("-")[0] for name in names if name.endswith(".whl"))
        assert wheels == ["wheels/refgs", "wheels/uv"]
        locks = {name for name in names if name.startswith("wheels/lock")}
        assert "wheels/lock.txt" in locks
        assert {name for name in names if not name.endswith(".whl")} == code | locks | {
            "blender_manifest.toml", "LICENSE",
        }  # fmt: skip


@pytest.mark.timeout(3000)
def test_what_is_released_can_be_installed(archive, tmp_path, monkeypatch):
    """Check that a released zip installs a working trainer by the real uv (package installer), and can remove it again.

    uv uses this machine's Python. It takes torch from the default package index, because a package mirror may lack the builds of torch for
    certain GPUs.
    """
    monkeypatch.setenv("UV_PYTHON_PREFERENCE", "only-system")
    monkeypatch.setenv("UV_TORCH_BACKEND", "")
    zipfile.ZipFile(archive).extractall(tmp_path / "extension")
    monkeypatch.setattr(installation, "WHEELS", tmp_path / "extension" / "wheels")
    home = tmp_path / "user folder" / "trainer"
    job, lines = commands.install(home, tmp_path / "log.txt"), []

    def done():
        if job.line and job.line not in lines:
            lines.append(job.line)
        return job.ended

    until(done, seconds=2900)
    assert job.state == "done", job.line + "\n" + job.log.read_text()[-3000:]
    print(
        "\n".join(lines), f"\n{installation.folder_bytes(home) / installation.GB:.2f} GB\n{installation.origin(home)}"
    )
    assert job.ready["refgs"] == installation.bundled_version() == installation.installed(home)
    assert any(line.startswith("Fetching ") for line in lines)
    origin = installation.origin(home)
    assert origin.startswith("All packages are those of the release, by their hashes") and "(torch 2." in origin
    asked = commands.query_trainer(installation.python(home), tmp_path / "asked.txt")
    assert final_state(asked, seconds=200) == "done" and asked.ready == job.ready
    program = "from refgs.settings import load_settings; print(load_settings('quick').train.iterations)"
    subprocess.run([installation.python(home), "-E", "-c", program], check=True, cwd=tmp_path)
    removed = commands.remove(home, tmp_path / "removed.txt")
    assert final_state(removed, seconds=200) == "done" and not home.exists()
