"""The lock of a run folder that a process works in. Others see it, read how far the training is, and can have it stop.

The lock is the system's: it goes with the process that holds it, however that ends. The Blender extension, which imports nothing from
here, looks at the same files (refgs_addon/jobs.py).
"""

import json
import time
from contextlib import suppress
from pathlib import Path

from filelock import FileLock, Timeout

from refgs.errors import InputError
from refgs.paths import whole

LOCK, PROGRESS, STOP = "run.lock", "progress.json", "stop"
EVERY = 1.0  # seconds between looks


class RunLock:
    """A run folder as this process's own, in a `with`. Raises InputError where another process works in it."""

    def __init__(self, folder: Path):
        self._folder, self._lock, self._next = folder, FileLock(folder / LOCK), 0.0

    def __enter__(self) -> "RunLock":
        try:
            self._lock.acquire(timeout=1)  # whoever looks whether it is held, holds it for a moment
        except Timeout:
            what = "another process trains it, or makes its mesh: wait until that has ended, or stop it"
            raise InputError(f"{self._folder} is in use: {what}") from None
        except OSError:  # a file system without locks
            pass
        self._tidy()
        return self

    def __exit__(self, *_) -> None:
        self._tidy()
        with suppress(OSError):  # Windows deletes no file that is open: there filelock does it
            (self._folder / LOCK).unlink()
        self._lock.release()

    def attend(self, iteration: int, total: int, seconds: float) -> bool:
        """To be called often: says now and then how far the training is; True where someone has asked that it stops."""
        now = time.monotonic()
        if now < self._next:
            return False
        self._next = now + EVERY
        left = seconds / max(iteration, 1) * (total - iteration)
        facts = {"iteration": iteration, "total": total, "seconds_left": left}
        # A reader that has the file open, on Windows, or a full disk is no reason to end a training.
        with suppress(OSError), whole(self._folder / PROGRESS) as temporary:
            temporary.write_text(json.dumps(facts), encoding="utf-8")
        return (self._folder / STOP).exists()

    def _tidy(self) -> None:
        for name in (PROGRESS, STOP):
            with suppress(OSError):
                (self._folder / name).unlink()
