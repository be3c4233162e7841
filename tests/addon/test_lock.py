"""Test that the add-on installs what was released and nothing else, by the real uv, from an index of tiny packages in a folder."""

import hashlib
import sys
import zipfile
from pathlib import Path

import pytest

from refgs_addon import jobs
from refgs_addon.trainer import commands, installation
from scripts.build_extension import write_locks
from tests.makers.waiting import final_state

uv = pytest.importorskip("uv")
WORKER = f"""print('{{"event": "ready", "protocol": {jobs.PROTOCOL}, "refgs": "9.9"}}')"""


def write_wheel(folder, name, version, code, requires=()):
    """Write a wheel of one module, and beside it the page of a package index that names it."""
    made, about = folder / f"{name}-{version}-py3-none-any.whl", f"{name}-{version}.dist-info"
    metadata = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\nProvides-Extra: farm\n"
    files = {
        f"{name}.py" if name != "refgs" else "refgs/cli.py": code,
        f"{about}/METADATA": metadata + "".join(f"Requires-Dist: {line}\n" for line in requires),
        f"{about}/WHEEL": "Wheel-Version: 1.0\nGenerator: RefGS\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(made, "w") as archive:
        for path, text in files.items():
            archive.writestr(path, text)
        archive.writestr(f"{about}/RECORD", "".join(f"{path},,\n" for path in (*files, f"{about}/RECORD")))
    digest = hashlib.sha256(made.read_bytes()).hexdigest()
    (folder / "index.html").write_text(f'<a href="{made.name}#sha256={digest}">{made.name}</a>')
    return made


@pytest.fixture
def release(tmp_path, monkeypatch):
    """Make a release whose trainer needs three packages, and lock them. Return the folder of its wheels, and the index.

    One of the three declares another, which pyproject.toml leaves out, and which the index does not have.
    """
    index, wheels = tmp_path / "simple", tmp_path / "wheels"
    write_wheel(index / "tiny", "tiny", "1.0", "a = 1\n")
    write_wheel(index / "torch", "torch", "2.14.0", "a = 1\n", ["tiny"])
    write_wheel(index / "matcher", "matcher", "1.0", "a = 1\n", ["left-out"])
    for name, value in {"UV_DEFAULT_INDEX": index.as_uri(), "UV_PYTHON_PREFERENCE": "only-system"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("UV_TORCH_BACKEND", "")
    write_wheel(wheels, "refgs", "9.9", WORKER, ["torch==2.14.0"])
    (wheels / "index.html").unlink()
    program = "uv.exe" if sys.platform == "win32" else "uv"
    with zipfile.ZipFile(wheels / "uv-1.0-py3-none-any.whl", "w") as archive:
        archive.write(uv.find_uv_bin(), f"uv-1.0.data/scripts/{program}")
    project = tmp_path / "clone" / "pyproject.toml"
    project.parent.mkdir()
    project.write_text(
        '[project]\nname = "refgs"\nversion = "9.9"\nrequires-python = ">=3.11"\ndependencies = ["torch==2.14.0"]\n'
        '[project.optional-dependencies]\nfarm = []\nlearned = ["matcher==1.0"]\n'
        '[tool.uv]\nexclude-dependencies = ["left-out"]\n'
    )
    monkeypatch.setattr("scripts.build_extension.TORCH_BUILDS", ())
    write_locks(project, wheels)
    monkeypatch.setattr(installation, "WHEELS", wheels)
    yield wheels, index
    jobs.stop_all()


def install(home):
    """Install the release. Return how that ended, and its line."""
    job = commands.install(home, home.with_suffix(".log"))
    return final_state(job, seconds=200), job.line


def test_a_release_is_installed_and_says_where_from(release, tmp_path):
    _, index = release
    assert install(tmp_path / "trainer") == ("done", "")
    expected = f"All packages are those of the release, by their hashes: 3 from {index.as_uri()} (torch 2.14.0)"
    assert installation.origin(tmp_path / "trainer") == expected
    assert expected in (tmp_path / "trainer.log").read_text()
    assert not (tmp_path / "trainer" / "torch.txt").exists()


def test_a_file_of_another_content_is_refused_until_the_right_one_is_there(release, tmp_path):
    _, index = release
    (file,) = (index / "tiny").glob("*.whl")
    right = file.read_bytes()
    write_wheel(index / "tiny", "tiny", "1.0", "a = 2\n")
    page = index / "tiny" / "index.html"
    page.write_text(f'<a href="{file.name}">{file.name}</a>')  # it does not give itself away
    state, line = install(tmp_path / "trainer")
    assert state == "failed" and "\n" not in line
    assert line.startswith("tiny==1.0: the file that was fetched is not the one that was released")
    assert "resume to fetch it again" in line and not installation.installed(tmp_path / "trainer")
    file.write_bytes(right)
    assert install(tmp_path / "trainer") == ("done", "")


def test_a_newer_package_of_the_index_is_not_taken(release, tmp_path):
    _, index = release
    write_wheel(index / "tiny", "tiny", "1.1", "a = 3\n")
    names = [file.name for file in (index / "tiny").glob("*.whl")]
    (index / "tiny" / "index.html").write_text("".join(f'<a href="{name}">{name}</a>' for name in names))
    assert install(tmp_path / "trainer") == ("done", "")
    assert [*(tmp_path / "trainer").rglob("tiny-1.0.dist-info")]


def test_a_build_of_torch_without_a_lock_is_not_taken(release, tmp_path, monkeypatch):
    """Check that a machine whose own build of torch was not locked gets the package index's. uv is asked by a file here, as no index is."""
    asked = {"UV_TORCH_BACKEND": "auto"}
    monkeypatch.setattr(installation, "_resolve", lambda *words: {"torch": ("2.14.0+cpu", "cpu's index")})
    wheels, _ = release
    assert installation._choose_lock(Path("uv"), asked, tmp_path, wheels) == wheels / "lock.txt"
    assert "UV_TORCH_BACKEND" not in asked
    asked = {"UV_TORCH_BACKEND": "auto"}
    (wheels / "lock-cpu.txt").touch()
    assert installation._choose_lock(Path("uv"), asked, tmp_path, wheels) == wheels / "lock-cpu.txt"
    assert asked == {"UV_TORCH_BACKEND": "cpu"}


@pytest.mark.skipif(sys.platform != "linux", reason="only there has the package index torch's CUDA build")
def test_room_is_asked_for_what_is_locked(release, monkeypatch):
    monkeypatch.setattr(installation.shutil, "which", lambda name: None)
    assert installation.needed_bytes() == installation.NEEDED_WITH_CARD
    (release[0] / "lock-cpu.txt").touch()
    assert installation.needed_bytes() == installation.NEEDED


def test_locks_have_hashes_and_no_address(release):
    wheels, index = release
    lock = (wheels / "lock.txt").read_text()
    assert lock.count("--hash=sha256:") == 3
    assert all(package in lock for package in ("matcher==1.0", "tiny==1.0", "torch==2.14.0"))
    assert "://" not in lock and str(index) not in lock


def test_a_checkout_says_that_it_has_no_lock(release, tmp_path):
    wheels, _ = release
    (wheels / "lock.txt").unlink()
    assert install(tmp_path / "trainer") == ("done", "")
    assert installation.origin(tmp_path / "trainer").startswith("This add-on has no lock of a release")


def test_hosts_are_named():
    """Check that packages are counted by host, and that an index's password is not written down."""
    where = {"torch": ("2.14.0+cpu", "https://me:secret@torch.example/whl/cpu")}
    where |= {name: ("1.0", "https://index.example/simple") for name in ("numpy", "scipy")}
    said = installation._describe_origin(where).removeprefix("All packages are those of the release, by their hashes: ")
    assert said == "1 from torch.example (torch 2.14.0+cpu), 2 from index.example"
