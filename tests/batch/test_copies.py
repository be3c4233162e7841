"""Test batches on machines that share no folder: a machine is played by processes for which the folder of the test is empty."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.many import MADE
from refgs import commands
from refgs.asked import Asked
from refgs.batch import copies
from refgs.batch.copies import Depot, at_hand, list_files, remove_copies
from refgs.errors import InputError, TryAgain
from tests.makers import processes
from tests.makers.batches import batch, ended, until
from tests.makers.training import TINY

ray = pytest.importorskip("ray")
RAY = str(Path(sys.executable).with_name("ray"))
CHANGES = [
    *TINY,
    "environment.resolution=16",
    "train.iterations=1500",
    "indirect.start=0.9",
    "indirect.resolution=48",
    "train.checkpoint_every=100",
]
CHANGES += ["mesh.resolution=32", "mesh.triangles=500", "mesh.texture=64"]
HIDE = 'mount -t tmpfs none "$0" && exec "$@"'


def hidden(folder: Path) -> list[str]:
    """Return the words that start a command for which a folder is empty. Skips the test where that is not allowed."""
    for words in (["unshare", "-m"], ["unshare", "-rm"]):
        command = [*words, "sh", "-c", HIDE, str(folder)]
        if shutil.which("unshare") and not subprocess.run([*command, "true"], capture_output=True).returncode:
            return command
    pytest.skip("folders cannot be hidden from a process here")


JOINED = """
import ray, sys, time
ray.init(address=sys.argv[1], log_to_driver=False)
while not ray.cluster_resources().get("CPU"):
    time.sleep(0.1)
"""


@contextmanager
def node(*words: object):
    """Run a command line of `ray start` for a `with` block. It and all its processes are killed at the end."""
    process = subprocess.Popen(
        list(map(str, words)), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        yield process
    finally:
        while left := processes.of_session(process.pid):
            for number in left:
                with suppress(ProcessLookupError):
                    os.kill(number, signal.SIGKILL)
            time.sleep(0.1)
        process.wait()


@pytest.fixture
def head(monkeypatch):
    """Start a cluster's head that runs no steps. Yields its address."""
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", 64 * "f")
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    temporary = tempfile.mkdtemp(prefix="ray-", dir="/tmp")
    words = ["start", "--head", f"--port={port}", "--num-cpus=0", "--include-dashboard=false", "--block"]
    with node(RAY, *words, f"--temp-dir={temporary}"):
        end = time.monotonic() + 60
        while socket.socket().connect_ex(("127.0.0.1", port)):
            assert time.monotonic() < end
            time.sleep(0.1)
        yield f"127.0.0.1:{port}"
    shutil.rmtree(temporary, ignore_errors=True)


def test_machines_that_share_nothing_make_the_same_asset(ball_capture, tmp_path, head):
    """Kill a machine on which a training runs. Check that another goes on from its last copied checkpoint, and leaves no copy."""
    shelf = tmp_path / "shelf"
    shelf.mkdir()
    start = [*hidden(shelf), RAY, "start", f"--address={head}", "--num-cpus=1", "--block"]
    shutil.copytree(ball_capture, shelf / "ball")
    changes = ", ".join(f'"{change}"' for change in CHANGES)
    (shelf / "list.toml").write_text(f'preset = "quick"\nset = [{changes}]\n[[captures]]\nfolder = "ball"\n')
    out, checkpoints = shelf / "runs", shelf / "runs" / "ball" / "checkpoints"
    with node(*start) as first:
        subprocess.run([sys.executable, "-c", JOINED, head], check=True, timeout=60, capture_output=True)
        process = batch(shelf / "list.toml", out, "--address", head)
        until(process, lambda: list(checkpoints.glob("*.toml")))
        assert not (out / "ball" / "splats.ply").exists()
        assert Path(f"/proc/{first.pid}/root{checkpoints}").exists()
    with node(*start) as second:
        status, said = ended(process)
        assert status == 0, said
        assert not any(Path(f"/proc/{second.pid}/root{shelf}").iterdir())
    assert "resumed" in (out / "logs" / "ball" / "train.log").read_text()
    commands.train(Asked(ball_capture, tmp_path / "plain", "quick", "cpu", changes=tuple(CHANGES)))
    commands.export(tmp_path / "plain")
    for file in MADE:
        assert (out / "ball" / file).read_bytes() == (tmp_path / "plain" / file).read_bytes(), file
    assert not list((out / "logs").glob("shared-*"))


class Local:
    """Call a depot's methods as Ray's actors are called, in this process. What they return stands for a reference to it."""

    def __init__(self, depot: Depot):
        self._depot = depot

    def __getattr__(self, name: str):
        return SimpleNamespace(remote=getattr(self._depot, name))


@pytest.fixture
def apart(tmp_path, monkeypatch):
    """Play two machines in one process: the depot's files are in tmp_path / "there", at the paths that they have without it.

    Returns a function that makes a depot.
    """
    monkeypatch.setattr(copies, "_get", lambda value: value)
    monkeypatch.setattr(ray, "put", lambda data: data)

    def there(root: Path) -> Path:
        return tmp_path / "there" / root.relative_to(tmp_path)

    class Far(Depot):
        def listing(self, root):
            return super().listing(there(root))

        def read(self, file, start):
            return super().read(there(file), start)

        def write(self, root, ticket, *rest):
            super()._check(root, ticket)
            super().write(there(root), 0, *rest)

        def remove(self, root, ticket, names):
            super()._check(root, ticket)
            super().remove(there(root), 0, names)

    return lambda: Local(Far(tmp_path / "logs" / "shared-1"))


def test_what_a_step_writes_is_copied_back_and_nothing_else(apart, tmp_path):
    capture, run, there = tmp_path / "cup", tmp_path / "runs" / "cup", tmp_path / "there"
    (there / "cup" / "images").mkdir(parents=True)
    (there / "cup" / "images" / "a.png").write_bytes(bytes(range(256)))
    (there / "cup" / "again").symlink_to(".")  # a circle
    (there / "cup" / "photos").symlink_to("images")
    (there / "runs" / "cup").mkdir(parents=True)
    (there / "runs" / "cup" / "old").write_text("old")
    depot = apart()
    with at_hand((capture,), (run,), depot):
        assert (capture / "images" / "a.png").read_bytes() == bytes(range(256)) and not (capture / "again").exists()
        (run / "old").unlink()
        (run / "sub").mkdir()
        (run / "sub" / "new").write_text("new")
        (run / "run.lock").touch()
        (capture / "mine").touch()
        (there / "runs" / "cup" / "added").touch()  # meanwhile, by somebody else
    assert list_files(there / "runs" / "cup").keys() == {"sub/new", "added"}
    assert (there / "runs" / "cup" / "sub" / "new").read_text() == "new"
    assert list_files(there / "cup").keys() == {"images/a.png", "photos/a.png"}
    with at_hand((capture,), (run,), depot):  # the copies become like what they copy
        assert list_files(capture).keys() == {"images/a.png", "photos/a.png"} and list_files(run).keys() == {
            "sub/new",
            "added",
        }
        assert list_files(run) == list_files(there / "runs" / "cup")
    remove_copies([capture, run], tmp_path / "logs" / "shared-1")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["there"]


def test_a_folder_that_is_no_copy_is_left_alone(apart, tmp_path):
    capture, there = tmp_path / "cup", tmp_path / "there" / "cup"
    for folder, text in ((capture, "mine"), (there, "theirs")):
        folder.mkdir(parents=True)
        (folder / "a.png").write_text(text)
    with (
        pytest.raises(InputError, match="cup is another one than where the batch runs: move it away"),
        at_hand((capture,), (), apart()),
    ):
        pass
    os.utime(capture / "a.png", (1e9, 1e9))
    os.utime(there / "a.png", (1e9, 1e9))
    (there / "a.png").write_text("mine")
    os.utime(there / "a.png", (1e9, 1e9))
    with at_hand((capture,), (), apart()):  # it has the same files: a folder that is shared
        pass
    remove_copies([capture], tmp_path / "logs" / "shared-1")
    assert (capture / "a.png").read_text() == "mine"


def test_a_step_that_was_given_up_writes_no_more(apart, tmp_path):
    run, depot = tmp_path / "runs" / "cup", apart()
    with pytest.raises(TryAgain, match="was started again on another machine"), at_hand((), (run,), depot):
        depot.begin.remote((run,))
        run.mkdir(parents=True)
        (run / "late").touch()
    assert not (tmp_path / "there").exists()
