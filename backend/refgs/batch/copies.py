"""Copy a step's files to a machine that does not share the batch's folder, and copy back what the step makes.

A step is one command of a batch, which Ray may run on any machine of a cluster. The originals are on the batch's machine, the one on which
`refgs batch` runs. A copy has the same path as its original, because commands and run folders name files by their paths. The bytes go
through Ray's object store.
"""

import os
import platform
import shutil
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any

from filelock import FileLock

from refgs.errors import InputError, TryAgain
from refgs.lock import LOCK
from refgs.paths import is_leftover, whole

EVERY = 5.0  # seconds from one copying back to the next while a step runs: what a machine's death costs
PART = 32 << 20  # bytes that are sent at once

Listing = dict[str, tuple[int, int]]
"""The files in a folder: size in bytes, and time of the last change in nanoseconds, by their paths in it."""


def list_files(root: Path) -> Listing:
    """List the files in the folder `root` and in the folders that it links to. Return {} if it does not exist.

    If `root` is a file, the listing has only this file, under the name ".". Lock files and half-written files are left out.
    """
    if root.is_file():
        return {".": _facts(root)}
    found = {}
    for folder, folders, files in os.walk(root, followlinks=True):
        if os.path.realpath(folder) in map(os.path.realpath, Path(folder).parents):  # a link to a folder above
            folders.clear()
            continue
        for file in (Path(folder, name) for name in files if name != LOCK):  # it holds on one machine only
            with suppress(FileNotFoundError):  # it was renamed or removed meanwhile
                if file.is_file() and not is_leftover(file):
                    found[file.relative_to(root).as_posix()] = _facts(file)
    return found


def _facts(file: Path) -> tuple[int, int]:
    facts = file.stat()
    return facts.st_size, facts.st_mtime_ns


class Depot:
    """Read and write files on the batch's machine for steps on other machines."""

    def __init__(self, mark: Path):
        """Remember the file `mark`, by which machines tell whether they share the batch's folder."""
        self._mark, self._tickets = mark, Counter()

    def begin(self, roots: tuple[Path, ...]) -> tuple[Path, dict[Path, int]]:
        """Register a step that writes to `roots`. Return the file `mark` (see `__init__`), and a ticket for each of `roots`.

        To write there, a step needs the ticket. Earlier tickets of a path are no longer valid: Ray has given up the steps that have them.
        """
        self._tickets.update(roots)
        return self._mark, {root: self._tickets[root] for root in roots}

    def listing(self, root: Path) -> Listing:
        """List the files in a folder, as `list_files` does."""
        return list_files(root)

    def read(self, file: Path, start: int) -> bytes:
        """Return PART bytes of a file from the byte `start`, fewer at its end."""
        with open(file, "rb") as opened:
            opened.seek(start)
            return opened.read(PART)

    def write(self, root: Path, ticket: int, name: str, parts: list[Any], time: int) -> None:
        """Write the file `name` in the folder `root`, completely or not at all. Raises TryAgain if `ticket` is no longer valid.

        `parts` are Ray references to its bytes, and `time` is its time of change in nanoseconds. `ticket` is from `begin`.
        """
        self._check(root, ticket)
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        _write(root / name, map(_get, parts), time)

    def remove(self, root: Path, ticket: int, names: list[str]) -> None:
        """Remove the files `names` from `root`. Raises TryAgain if `ticket` is no longer valid."""
        self._check(root, ticket)
        for name in names:
            (root / name).unlink(missing_ok=True)

    def _check(self, root: Path, ticket: int) -> None:
        if ticket != self._tickets[root]:
            raise TryAgain(f"{root}: the step was started again on another machine")


@contextmanager
def at_hand(reads: tuple[Path, ...], writes: tuple[Path, ...], depot: Any) -> Iterator[None]:
    """Copy files and folders from the batch's machine to this one for a `with` block, and copy back what the block writes.

    `depot` is the actor `Depot` on the batch's machine. If `depot` is None, or if this machine shares the batch's folder, nothing is
    copied. Otherwise, `reads` and `writes` are copied before the block. Changes in `writes` are copied back during the block and after it.
    The copies stay for the next step (see `remove_copies`).

    Raises InputError if this machine has other files at one of these paths. Copies that an earlier step made are no error. Raises TryAgain
    if the batch's machine does not answer, or if the step was started again on another machine.
    """
    if depot is None:
        yield
        return
    mark, tickets = _get(depot.begin.remote(writes))
    if mark.exists():
        yield
        return
    mark.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(mark.parent / "copies.lock"):  # steps of one capture copy it once
        there = {root: _fetch(root, depot) for root in (*reads, *writes)}
    back = _Back({root: (ticket, there[root]) for root, ticket in tickets.items()}, depot)
    try:
        yield
    finally:
        back.end()


def remove_copies(roots: list[Path], mark: Path) -> None:
    """Remove the copies of a batch's files and folders `roots` from this machine.

    `mark` is a file in the batch's folder. If `mark` exists on this machine, the machine shares that folder. Its files are then the
    originals, and none is removed.
    """
    if mark.exists():
        return
    for root in roots:
        if _mark(root).exists():
            shutil.rmtree(root) if root.is_dir() else root.unlink(missing_ok=True)
            _mark(root).unlink()
    with suppress(OSError):  # not empty, or never made
        (mark.parent / "copies.lock").unlink()
    for empty in {mark.parent, *(root.parent for root in roots)}:
        with suppress(OSError):
            os.removedirs(empty)


def _mark(root: Path) -> Path:
    """Return the path of the empty file that marks `root` as a copy."""
    # It lies beside `root`, because the contents of a folder belong to the step.
    return root.with_name(f".{root.name}.refgs-copy")


def _fetch(root: Path, depot: Any) -> Listing:
    """Fetch `root` and return its listing. Raises InputError if other files are there already."""
    there, here = _get(depot.listing.remote(root)), list_files(root)
    if not _mark(root).exists():
        if here and here == there:  # this folder is shared
            return there
        if here:
            what = f"{platform.node()}: {root} is another one than where the batch runs"
            raise InputError(f"{what}: move it away, or share the folder with all machines")
        root.parent.mkdir(parents=True, exist_ok=True)
        _mark(root).touch()
    for name in here.keys() - there.keys():
        (root / name).unlink()
    for name, facts in there.items():
        if here.get(name) != facts:
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            _write(root / name, _parts(root / name, depot), facts[1])
    return there


def _parts(file: Path, depot: Any) -> Iterator[bytes]:
    for start in count(0, PART):
        part = _get(depot.read.remote(file, start))
        yield part
        if len(part) < PART:
            return


def _write(file: Path, parts: Iterator[bytes], time: int) -> None:
    with whole(file, durable=False) as temporary:
        with open(temporary, "wb") as opened:
            for part in parts:
                opened.write(part)
        os.utime(temporary, ns=(time, time))


class _Back:
    """Copy changed files back to their originals in a thread, until `end` is called."""

    def __init__(self, folders: dict[Path, tuple[int, Listing]], depot: Any):
        """Start the thread; `folders` maps each folder to its ticket and the original's listing."""
        self._folders, self._depot, self._error = folders, depot, None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Copy for the last time. Raises any error that copying has raised."""
        self._over.set()
        while self._thread.is_alive():
            with suppress(KeyboardInterrupt):  # Ray says more than once that a step is to stop
                self._thread.join()
        if self._error:
            raise self._error

    def _work(self) -> None:
        try:
            while not self._over.wait(EVERY):
                self._copy()
            self._copy()
        except Exception as error:
            self._error = error

    def _copy(self) -> None:
        for root, (ticket, there) in self._folders.items():
            here = list_files(root)
            changed = [(facts, name) for name, facts in here.items() if there.get(name) != facts]
            # In the order in which they were written: the file that says that a run is complete comes last.
            for facts, name in sorted(changed, key=lambda one: (one[0][1], one[1])):
                with suppress(FileNotFoundError):  # it was removed meanwhile
                    self._send(root, ticket, name, facts[1])
                    there[name] = facts
            if gone := [name for name in there if name not in here]:
                _get(self._depot.remove.remote(root, ticket, gone))
                for name in gone:
                    del there[name]

    def _send(self, root: Path, ticket: int, name: str, time: int) -> None:
        import ray

        parts = []
        with open(root / name, "rb") as file:
            while part := file.read(PART):
                parts.append(ray.put(part))
        _get(self._depot.write.remote(root, ticket, name, parts, time))


def _get(reference: Any) -> Any:
    """Wait for the value of a Ray reference, raising the remote call's error or TryAgain."""
    import ray
    import ray.exceptions

    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None
    except ray.exceptions.RayError as error:
        raise TryAgain(f"the batch's machine does not answer ({type(error).__name__})") from None
