"""Test that paths are printed as they are, whatever is in them, and that errors are one line."""

import os
import shlex
import subprocess
import sys

import pytest

from refgs.errors import one_line
from refgs.formats.splats import write_splats
from tests.makers.captures import nerfstudio
from tests.makers.splats import make


def refgs(folder, *words, **variables) -> subprocess.CompletedProcess:
    """Run the command `refgs` in a folder with these arguments, and decode what it says."""
    command = [sys.executable, "-m", "refgs.cli", *words]
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, encoding="utf-8", env=os.environ | variables
    )


def test_paths_are_printed_as_they_are(tmp_path):
    """Check that a job succeeds and names its file, though the name looks like markup, and the terminal's encoding lacks a letter."""
    write_splats(tmp_path / "a.ply", make(10))
    name = "[/red] jar [final] :smile: $x$"
    done = refgs(tmp_path, "export", "a.ply", "--splats", f"{name}/Σ.ply", PYTHONIOENCODING="ascii")
    assert (done.returncode, done.stdout.strip()) == (0, f"wrote {name}/\\u03a3.ply"), done.stderr
    assert (tmp_path / name / "Σ.ply").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="its shell quotes otherwise")
def test_a_command_to_type_is_quoted(tmp_path):
    name = "it's a [final] $HOME"
    photos = nerfstudio(tmp_path / name)
    (photos / "transforms.json").unlink()
    done = refgs(tmp_path, "check", name)
    command = done.stderr.partition("Find them first: ")[2]
    assert done.returncode == 2 and shlex.split(command) == ["refgs", "poses", name]


def test_an_error_is_one_line(tmp_path):
    done = refgs(tmp_path, "check", "two\nlines\x1b[2J")
    assert done.returncode == 2 and done.stderr.startswith("refgs: two\\nlines\\x1b[2J: there is no such folder")
    assert done.stderr.count("\n") == 1
    assert one_line("a\u2028b \ud800 größe \N{NO-BREAK SPACE}") == "a\\u2028b \\ud800 größe \N{NO-BREAK SPACE}"


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="names of files are Unicode there")
@pytest.mark.parametrize("words", ["check FOLDER", "train photos --out NEW"])
def test_a_name_that_is_not_unicode(tmp_path, words):
    folder, new = os.fsdecode(b"caf\xe9"), os.fsdecode(b"new \xe9")
    nerfstudio(tmp_path / folder), nerfstudio(tmp_path / "photos")
    words = [{"FOLDER": folder, "NEW": new}.get(word, word) for word in words.split()]
    done = refgs(tmp_path, *words)
    assert done.returncode == 2 and "not Unicode: rename" in done.stderr and done.stderr.count("\n") == 1, done.stderr
