"""Lock a run folder while a process works in it. Other processes see the lock, can read the training's progress, and can stop it.

The operating system holds the lock. It releases the lock when the process ends, even if it is killed. The Blender extension reads the same
files with its own code, without importing this module.
"""

import errno
import json
import time
from contextlib import suppress
from pathlib import Path

from filelock import FileLock, Timeout

from refgs.errors import TryAgain
from refgs.paths import NO_LOCKS, remove_leftovers, write_text

LOCK, PROGRESS, STOP = "run.lock", "progress.json", "stop"
EVERY = 1.0  # seconds between looks


class RunLock:
    """Lock a run folder for this process during a `with` block.

    Raises TryAgain if another process has locked the folder. Also raises it if the lock file cannot be opened, for example because the disk
    is full or because another user owns the file. On a file system without locks, nothing is locked.

    Half-written files that killed processes left in the folder are removed. A folder that does not exist is made.
    """

    def __init__(self, folder: Path):
        self._folder, self._lock, self._next = folder, FileLock(folder / LOCK), 0.0

    def __enter__(self) -> "RunLock":
        try:
            self._lock.acquire(timeout=1)  # a process that only tests the lock holds it for a moment
        except Timeout:
            what = "another process trains it, or makes its mesh: wait until that has ended, or stop it"
            raise TryAgain(f"{self._folder} is in use: {what}") from None
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise self._refused(error) from None
        try:
            self._tidy()
            remove_leftovers(self._folder)
        except BaseException:  # also what the handler of a signal raises
            self._release()
            raise
        return self

    def __exit__(self, *_) -> None:
        try:
            self._tidy()
        finally:
            self._release()

    def attend(self, iteration: int, total: int, seconds: float) -> bool:
        """Write the training's progress to progress.json. Return True if another process has asked this one to stop.

        Call this in every iteration. It writes and checks once a second, and otherwise returns False. `seconds` is the time spent so far,
        `total` the number of all iterations.
        """
        now = time.monotonic()
        if now < self._next:
            return False
        self._next = now + EVERY
        left = seconds / max(iteration, 1) * (total - iteration)
        facts = {"iteration": iteration, "total": total, "seconds_left": left}
        # A reader that has the file open on Windows, or a full disk, must not end the training.
        with suppress(OSError):
            write_text(self._folder / PROGRESS, json.dumps(facts), durable=False)
        return (self._folder / STOP).exists()

    def _refused(self, error: OSError) -> TryAgain:
        file, again = self._folder / LOCK, "then run the same command again"
        if file.exists() and error.errno in (errno.EACCES, errno.EPERM):
            what = f"wait until their training has ended, or delete the file if none runs, {again}"
            return TryAgain(f"{file} belongs to another user ({error.strerror}): {what}")
        return TryAgain(f"{file} cannot be written ({error.strerror}): mend that, {again}")

    def _release(self) -> None:
        if self._lock.is_locked:  # not on a file system without locks, where it may be another process's
            with suppress(OSError):  # Windows deletes no open file: there filelock deletes it
                (self._folder / LOCK).unlink()
        self._lock.release()

    def _tidy(self) -> None:
        for name in (PROGRESS, STOP):
            with suppress(OSError):
                (self._folder / name).unlink()


def remove_stale_lock(folder: Path) -> None:
    """Remove a killed process's lock and half-written files, unless another process holds the lock."""
    if (folder / LOCK).exists():
        with suppress(TryAgain), RunLock(folder):
            pass
