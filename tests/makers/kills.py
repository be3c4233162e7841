"""Start commands to be killed, each in a session of its own, and list what they have left."""

import json
import os
import random
import signal
import sys
import time
from fnmatch import fnmatch
from pathlib import Path

from filelock import FileLock, Timeout

from refgs import cli
from refgs.lock import LOCK
from tests.makers import processes
from tests.makers.batches import batch
from tests.makers.forks import loaded
from tests.makers.training import TINY

CHANGES = [*TINY, "environment.resolution=16", "train.iterations=30", "train.checkpoint_every=8", "densify.every=10"]
CHANGES += ["light.exposure=on", "indirect.start=0.2", "indirect.every=8", "indirect.resolution=32"]
CHANGES += ["needs.reflections=on", "mesh.resolution=32", "mesh.triangles=500", "mesh.texture=64"]
TIMED = ("metrics.json", "checkpoints/*.toml", "index.html", "logs/*")  # hold seconds


def files(run: Path) -> dict[str, object]:
    """Read the files of a run, by their paths. Leave out seconds, and log.txt, which tells of faults before a resume."""
    found = {file.relative_to(run).as_posix(): file for file in run.rglob("*") if not file.is_dir()}
    found.pop("log.txt", None)
    return {name: None if any(fnmatch(name, one) for one in TIMED) else _read(file) for name, file in found.items()}


def _read(file: Path) -> object:
    if file.name == "history.jsonl":
        return file.read_bytes().count(b"\n")
    if file.name == "needs.json":
        return [{k: v for k, v in row.items() if k not in ("seconds", "saved")} for row in json.loads(file.read_text())]
    return file.read_bytes()


def result(run: Path) -> dict[str, object]:
    """Read the files of a run by `files`, without what its interruptions leave on purpose.

    A training that was told to end has written a checkpoint and a line of history there. Of the checkpoints, the last counts.
    """
    found = files(run)
    for name in sorted(name for name in found if fnmatch(name, "checkpoints/" + 8 * "[0-9]" + ".*"))[:-2]:
        del found[name]
    return found | {name: None for name in found if name == "history.jsonl"}


def files_of_batch(out: Path) -> dict[str, object]:
    """Read the files of all runs of a batch, and those about it."""
    runs = {file.parent.name for file in out.glob("*/run.toml")}
    found = {f"{run}/{name}": value for run in runs for name, value in result(out / run).items()}
    others = [file.relative_to(out) for file in out.rglob("*") if not file.is_dir()]
    return found | {file.as_posix(): None for file in others if file.parts[0] not in runs}


def is_locked(run: Path) -> bool:
    """Tell whether a run folder is locked."""
    try:
        if (run / LOCK).exists():
            FileLock(run / LOCK, timeout=0).acquire().lock.release()
        return False
    except Timeout:
        return True


class Command:
    """Run a command of refgs as the child of a process that holds its input open, as Blender and batches do.

    `words` are those of the command. `jobs` are what a worker is told to do. What is printed goes to the file `said`.
    """

    def __init__(self, said: Path, words: list, jobs: tuple[dict, ...] = ()):
        self._process = loaded().Process(target=_parent, args=(said, list(map(str, words)), jobs))
        self._process.start()
        self.session = self._process.pid

    def wait(self, seconds: float | None) -> int | None:
        """Wait for some seconds. Return the exit status, None if the command has not ended."""
        self._process.join(seconds)
        return self._process.exitcode

    def kill(self, moments: random.Random) -> str:
        """Kill the command or its parent, and say which. Returns when the parent has ended."""
        child = next((number for number in processes.of_session(self.session) if number != self.session), None)
        victim = moments.choice(["command", "parent"]) if child else "parent"
        try:
            os.kill(child if victim == "command" else self.session, signal.SIGKILL)
        except ProcessLookupError:  # it has just ended
            self._process.kill()
        self._process.join()
        return victim


def _parent(said: Path, words: list[str], jobs: tuple[dict, ...]) -> None:
    os.setsid()
    with open(said, "a", buffering=1) as log:
        os.dup2(log.fileno(), 2)
        ours, theirs = os.pipe(), os.pipe()  # its input, its output
        child = os.fork()
        if child == 0:
            os.dup2(ours[0], 0)
            os.dup2(theirs[1], 1)
            for end in (*ours, *theirs):
                os.close(end)
            if not jobs:
                os.environ["REFGS_END_WITH_INPUT"] = "1"
            sys.stdout, sys.stderr = open(1, "w"), open(2, "w")  # noqa: SIM115  those from before may be of files, which can seek
            sys.argv = ["refgs", *words]
            cli.main()
            sys.exit(0)
        os.close(ours[0])
        os.close(theirs[1])
        os.write(ours[1], "".join(json.dumps(job) + "\n" for job in jobs).encode())
        left, failed = len(jobs), False
        with os.fdopen(theirs[0]) as heard:
            for line in heard:
                log.write(line)
                failed |= '"event": "failed"' in line
                left -= '"event": "done"' in line
                if jobs and (failed or left == 0):
                    os.close(ours[1])
                    jobs = ()
        _, status = os.waitpid(child, 0)
        sys.exit(1 if failed else abs(os.waitstatus_to_exitcode(status)))


class Batch:
    """Run `refgs batch` of a list into the folder `out`, with two workers."""

    def __init__(self, source: Path, out: Path):
        self._process = batch(source, out, "--workers", "2")
        self.session = self._process.pid

    def wait(self, seconds: float | None) -> int | None:
        """Wait for some seconds. Return the exit status, None if it has not ended."""
        end = time.monotonic() + (seconds if seconds is not None else 3600)
        while self._process.poll() is None and time.monotonic() < end:
            time.sleep(0.05)
        return self._process.poll()

    def kill(self, moments: random.Random) -> str:
        """Kill the batch's own process. Ray, its child, has to end by itself."""
        self._process.kill()
        self._process.wait()
        return "parent"
