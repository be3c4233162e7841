"""Start `refgs worker` as a fork of a process that has loaded the trainer, which saves the three seconds of loading it."""

import multiprocessing
import os
import sys
from multiprocessing.connection import Connection

from refgs import cli


def loaded():
    """Return a context of multiprocessing whose processes are forks of one that has loaded the trainer."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["refgs.train.trainer", "refgs.commands", "refgs.worker", "refgs.export.bake"])
    return context


class Worker:
    """Run `refgs worker` with pipes as its standard input and output. It has those members of `subprocess.Popen` that tests use."""

    def __init__(self):
        context = loaded()
        theirs, ours = zip(context.Pipe(False), reversed(context.Pipe(False)), strict=True)
        self._process = context.Process(target=_work, args=theirs)
        self._process.start()
        for end in theirs:
            end.close()
        write, read = (os.dup(end.fileno()) for end in ours)
        self.stdin, self.stdout = os.fdopen(write, "w", encoding="utf-8"), os.fdopen(read, encoding="utf-8")

    def terminate(self) -> None:
        self._process.terminate()

    def kill(self) -> None:
        self._process.kill()

    def wait(self, timeout: float | None = None) -> int:
        """Wait until the worker has ended, and return its exit status."""
        self._process.join(timeout)
        assert self._process.exitcode is not None, "the worker does not end"
        return self._process.exitcode


def _work(source: Connection, out: Connection) -> None:
    os.dup2(source.fileno(), 0)
    os.dup2(out.fileno(), 1)
    source.close()
    out.close()
    sys.stdin, sys.stdout = os.fdopen(0), os.fdopen(1, "w")
    sys.argv = ["refgs", "worker"]
    cli.main()
