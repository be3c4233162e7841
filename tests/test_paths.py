"""Test that files are written completely or not at all, whoever else writes in their folder."""

import errno
import os
import secrets
import time

import pytest

from refgs.errors import TRY_AGAIN
from refgs.lock import RunLock
from refgs.paths import read_bytes, whole, write_text
from tests.makers.disk import fill
from tests.makers.mutants import put_link


def test_two_writers_of_a_file_do_not_share_what_is_not_complete(tmp_path):
    file = tmp_path / "metrics.json"
    with whole(file) as one:
        one.write_text("a long text by the first")
        write_text(file, "short")
        assert file.read_text() == "short"
    assert file.read_text() == "a long text by the first"
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege there")
def test_a_link_in_the_way_is_not_followed(tmp_path, monkeypatch):
    victim, run = tmp_path / "victim", tmp_path / "run"
    victim.write_text("precious")
    run.mkdir()
    monkeypatch.setattr(secrets, "token_hex", lambda count: "0" * 2 * count)
    with whole(run / "a.json") as temporary:
        name = temporary.name
    (run / "metrics.json.tmp").symlink_to(victim)
    (run / name).symlink_to(victim)
    with pytest.raises(FileExistsError, match=r"metrics\.json"):
        write_text(run / "metrics.json", "ours")
    assert victim.read_text() == "precious"


@pytest.mark.skipif(os.name == "nt", reason="modes are POSIX's")
def test_others_may_read_what_is_written(tmp_path):
    (tmp_path / "plain").touch()
    write_text(tmp_path / "a.json", "")
    assert (tmp_path / "a.json").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_failed_write_leaves_the_file_before(tmp_path):
    write_text(tmp_path / "a.json", "before")
    with pytest.raises(KeyError), whole(tmp_path / "a.json") as temporary:
        temporary.write_text("half")
        raise KeyError
    assert (tmp_path / "a.json").read_text() == "before" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("refusals", [2, 100])
def test_a_file_that_windows_refuses_to_replace(tmp_path, monkeypatch, refusals):
    """Check that a file which another program reads for a moment is replaced after it, and that the old one stays otherwise."""
    file, replace, left = tmp_path / "a.json", os.replace, [refusals]
    file.write_text("before")

    def refuse(source, target):
        left[0] -= 1
        if left[0] >= 0:
            raise PermissionError(errno.EACCES, "Access is denied", str(source))
        replace(source, target)

    monkeypatch.setattr(os, "replace", refuse)
    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    if refusals == 2:
        write_text(file, "after")
        assert file.read_text() == "after"
    else:
        with pytest.raises(PermissionError, match=r"denied: '.*a\.json'"):
            write_text(file, "after")
        assert file.read_text() == "before"
    assert list(tmp_path.iterdir()) == [file]


def test_a_full_disk_is_said_of_the_file(small_disk):
    fill(small_disk / "filler")
    with pytest.raises(OSError, match="No space left"):
        write_text(small_disk / "a.json", "text")
    assert [file.name for file in small_disk.iterdir()] == ["filler"]


def test_a_folder_that_is_gone_is_said_of_the_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"gone/a\.json"):
        write_text(tmp_path / "gone" / "a.json", "text")


@pytest.mark.skipif(os.name == "nt", reason="needs fork")
def test_the_next_start_removes_what_killed_writes_left(tmp_path):
    run = tmp_path / "run"
    for folder in (run, run / "checkpoints"):
        folder.mkdir()
        if (child := os.fork()) == 0:
            with whole(folder / "a.json"):
                os._exit(0)  # as a killed process, it never ends the block
        os.waitpid(child, 0)
    left = [file for file in run.rglob("*") if file.is_file()]
    own = run / "notes.tmp"
    own.touch()
    with RunLock(run):
        assert len(left) == 2 and not any(file.exists() for file in left) and own.exists()


@pytest.mark.parametrize(("when", "what"), [("begin", "remove_leftovers"), ("end", "RunLock._tidy")])
def test_a_lock_that_a_signal_interrupts_is_not_left(tmp_path, monkeypatch, when, what):
    def interrupted(*_):
        raise SystemExit(TRY_AGAIN)

    lock = RunLock(tmp_path)
    if when == "end":
        lock.__enter__()
    monkeypatch.setattr(f"refgs.lock.{what}", interrupted)
    with pytest.raises(SystemExit):
        lock.__enter__() if when == "begin" else lock.__exit__(None, None, None)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.undo()
    with RunLock(tmp_path):
        pass


@pytest.mark.parametrize("other", ["", "/dev/zero"])
def test_what_is_no_file_is_not_read(tmp_path, other):
    put_link(tmp_path / "a", other)
    with pytest.raises(OSError, match="this is not a file"):
        read_bytes(tmp_path / "a")
