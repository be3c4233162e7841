"""Start batches in processes of their own, and wait for them."""

import signal
import subprocess
import sys
import time
from contextlib import contextmanager

from tests.makers import processes

PATIENCE = 240.0  # seconds


def batch(source, out, *words, cwd=None) -> subprocess.Popen:
    """Start `refgs batch` in a session of its own, on the CPU. Its output is in its pipe `stdout`.

    It ignores SIGINT at first, as in the background of a shell script.
    """
    command = [sys.executable, "-Pm", "refgs.cli", "batch", source, "--out", out, "--device", "cpu", *words]
    with ignored(signal.SIGINT):
        return subprocess.Popen(
            list(map(str, command)),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            cwd=cwd,
        )


@contextmanager
def ignored(number: signal.Signals):
    """Ignore a signal for a `with` block. Processes that it starts ignore it, too, unless they handle it."""
    before = signal.signal(number, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(number, before)


def until(process, condition):
    """Wait until `condition()` is true and return its value. The batch must not have ended before."""
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert process.poll() is None, process.stdout.read()
        assert time.monotonic() < end
        time.sleep(0.05)
    return found


def ended(process, patience: float = PATIENCE, grace: float = 30) -> tuple[int, str]:
    """Wait for a batch to end, `patience` seconds at most. Check that no process of its session is left, and no command.

    Those have `grace` seconds to end after it. Return its exit status and what it printed.
    """
    said, _ = process.communicate(timeout=patience)
    end = time.monotonic() + grace
    while left := [*processes.of_session(process.pid).values(), *processes.commands("refgs.cli", str(process.args[6]))]:
        assert time.monotonic() < end, left
        time.sleep(0.1)
    return process.returncode, said
