"""Test the lock of a run folder between two users, and on file systems without locks."""

import errno
import os
import tempfile
from pathlib import Path

import pytest
from filelock import FileLock

from refgs.errors import TryAgain
from refgs.kernels import build
from refgs.lock import LOCK, PROGRESS, RunLock
from tests.makers.users import as_nobody

root = pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can become another user")


@pytest.fixture
def shared():
    """Make a folder that all users can write in."""
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o777)
        yield Path(folder)


def enter(folder):
    with RunLock(folder):
        return "locked"


@root
def test_another_user_does_not_get_into_a_run_that_is_written(shared):
    left, progress = shared / f".refgs-{'0' * 16}.tmp", shared / PROGRESS
    with RunLock(shared):
        left.touch()
        progress.touch()
        said = as_nobody(lambda: enter(shared))
        assert (
            said.startswith(f"TryAgain: {shared / LOCK} belongs to another user (Permission denied)")
            and "\n" not in said
        )
        assert left.exists() and progress.exists() and (shared / LOCK).exists()
        with pytest.raises(TryAgain, match="is in use"):
            enter(shared)
    assert as_nobody(lambda: enter(shared)) == "locked" and [*shared.iterdir()] == []


@root
def test_a_folder_of_another_user(shared):
    (shared / "run").mkdir(mode=0o755)
    said = as_nobody(lambda: enter(shared / "run"))
    assert said.startswith(f"TryAgain: {shared / 'run' / LOCK} cannot be written (Permission denied)")


@root
def test_another_user_does_not_build_beside_a_build(shared):
    made = shared / "build-1"
    made.mkdir()

    def work():
        with build._sole_build(shared):
            return "built"

    with FileLock(shared / "build.lock"):
        assert as_nobody(work).startswith("PermissionError")
        assert made.exists()


def fail(code):
    def acquire(*_, **__):
        raise OSError(code, os.strerror(code))

    return acquire


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP])
def test_a_file_system_without_locks(tmp_path, monkeypatch, code):
    (tmp_path / LOCK).touch()  # another process's: this one holds none
    monkeypatch.setattr(FileLock, "acquire", fail(code))
    assert enter(tmp_path) == "locked" and (tmp_path / LOCK).exists()


@pytest.mark.parametrize("code", [errno.EIO, errno.ENOSPC, errno.EROFS, errno.EACCES])
def test_a_lock_that_cannot_be_written(tmp_path, monkeypatch, code):
    monkeypatch.setattr(FileLock, "acquire", fail(code))
    with pytest.raises(TryAgain, match=rf"run\.lock cannot be written \({os.strerror(code)}\): mend that") as error:
        enter(tmp_path)
    assert "\n" not in str(error.value)
