"""Run a step of a batch, one command such as `refgs train`, in a process of its own, and record how it ended.

Ray's workers import this module. It imports little, so that they start soon.
"""

import json
import os
import platform
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

from refgs.batch.copies import at_hand
from refgs.errors import InputError, TryAgain
from refgs.paths import disk_errors_named, write_text

PATIENCE = 15.0  # seconds for a command to end after its input was closed
FAILED = (1, 2)  # exit statuses after which a retry is useless


class Step(NamedTuple):
    """Describe a step: its `name`, such as "train", the `run` it belongs to, and the `words` of its command after `refgs`.

    `log` is the file for the command's output. Beside it is a JSON file that records the outcome. `made` is a file that must exist once the
    step is done, or None. `reads` and `writes` are the files and folders that the step uses; the folder of `log` is one of `writes`.
    """

    name: str
    run: str
    words: tuple[str, ...]
    log: Path
    made: Path | None = None
    reads: tuple[Path, ...] = ()
    writes: tuple[Path, ...] = ()

    @property
    def running(self) -> Path:
        """Return the path of the file that exists only while the step runs."""
        return self.log.with_suffix(".running")


class Outcome(NamedTuple):
    """Hold how a step ended: its exit status, its run time in seconds, the machine's name, and the reason in one line if it failed.

    The status is None if the step was not run because an earlier step failed, or if the step was cancelled.
    """

    status: int | None
    seconds: float = 0.0
    node: str = ""
    what: str = ""


class TryLater(Exception):
    """Report that a step may succeed if Ray runs it again."""


def recorded(step: Step) -> Outcome | None:
    """Return the outcome of the same step's earlier success, or None if it must run."""
    from refgs.formats.progress import Record
    from refgs.formats.validate import read_json

    try:
        found = read_json(step.log.with_suffix(".json"), Record, "")
    except InputError:
        return None
    there = step.made is None or step.made.exists()
    same = found.words == [*step.words] and found.status == 0
    return Outcome(found.status, found.seconds, found.node) if same and there else None


def run_step(step: Step, cores: int, pause: float, depot: Any, optional: tuple[bool, ...], *before: Outcome) -> Outcome:
    """Run a step and record its outcome beside its log. Do not run it if an earlier step that must succeed has failed.

    `cores` is the number of threads. `depot` copies files from and to the machine on which `refgs batch` runs; it is None if all steps run
    there. `before` are the outcomes of the earlier steps that this one waits for. `optional` says for each of them whether it may fail.

    Waits `pause` seconds and raises TryLater if the command was killed, if its exit status means that a retry may succeed, or if files
    cannot be copied or written.
    """
    if any(outcome.status != 0 and not may_fail for outcome, may_fail in zip(before, optional, strict=True)):
        return Outcome(None)
    # Ray stops a step by SIGINT, which Python ignores if the batch was started in the background of a shell script.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with disk_errors_named([], "run the batch again"), at_hand(step.reads, step.writes, depot):
            outcome = _run_and_record(step, cores)
    except TryAgain as error:
        time.sleep(pause)
        raise TryLater(str(error)) from None
    except OSError as error:  # a folder that somebody has moved away, say
        time.sleep(pause)
        raise TryLater(f"{error.filename or step.log.parent} cannot be read or written ({error.strerror})") from None
    except InputError as error:
        return Outcome(2, node=platform.node(), what=str(error))
    if outcome.status and outcome.status not in FAILED:
        time.sleep(pause)
        raise TryLater(outcome.what)
    return outcome


def _run_and_record(step: Step, cores: int) -> Outcome:
    """Run a step's command, and record its outcome unless a retry may change it."""
    begun, node = time.monotonic(), platform.node()
    step.log.parent.mkdir(parents=True, exist_ok=True)
    step.running.touch()
    try:
        with open(step.log, "a+b") as log:
            status, printed = _call(step, cores, log)
    finally:
        step.running.unlink(missing_ok=True)
    outcome = Outcome(status, time.monotonic() - begun, node, "" if status == 0 else _line(printed, status))
    if status in (0, *FAILED):
        facts = outcome._asdict() | {"words": step.words}
        write_text(step.log.with_suffix(".json"), json.dumps(facts, indent=1))
    return outcome


def _call(step: Step, cores: int, log) -> tuple[int, str]:
    """Run a step's command, which ends with this process; return exit status and output."""
    # The command ends when its input closes: the operating system closes it if this process is killed.
    log.write(f"$ refgs {' '.join(step.words)}\n".encode())
    log.flush()
    start = log.tell()
    environment = os.environ | {"REFGS_END_WITH_INPUT": "1", "OMP_NUM_THREADS": str(cores), "PYTHONUNBUFFERED": "1"}
    environment["PYTHONSAFEPATH"] = "1"  # import nothing that lies beside the captures, nor let the step's own children
    command = [sys.executable, "-P", "-m", "refgs.cli", *step.words]
    # In a group of its own: Ray kills the whole group of a worker that dies, and a training could write no checkpoint.
    group = 0 if os.name == "posix" else None
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=log, stderr=subprocess.STDOUT, env=environment, process_group=group
    )
    try:
        while process.poll() is None:
            time.sleep(0.1)  # and not `wait`: Ray interrupts Python code alone
    finally:
        try:
            process.communicate(timeout=PATIENCE)  # closes its input
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    log.seek(start)
    return process.returncode, log.read().decode(errors="replace")


def _line(printed: str, status: int) -> str:
    """Return in one line why a command failed: signal, last error, or exit status."""
    lines = [line.removeprefix("refgs: ") for line in printed.splitlines() if line.startswith("refgs: ")]
    if status < 0:
        return f"killed by signal {-status}"
    return lines[-1] if lines else f"ended with status {status}"
