"""Run the trainer and other slow programs as separate processes, so that Blender stays responsive. This module needs no bpy.

Each job has its own worker process, which gets commands on stdin and prints events to stdout (docs/job-protocol.md). A thread reads the
events into a queue, and `poll` handles them.

When Blender ends, the stdin of each worker closes, and the worker stops. The artist can choose that a training continues: its worker then
finishes without Blender. A worker locks the run folder in which it works, so that every Blender can see that this folder is in use.
"""

import contextlib
import json
import math
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path

from .errors import InputError
from .json_file import read_json

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

PROTOCOL = 1
TRAINER, BLENDER = "the trainer", "Blender"  # programs that run jobs
ENDED = ("done", "cancelled", "failed")
_FIRST = {"train": "Reading the photos", "batch": "Starting Ray"}  # step of a job that has sent no progress yet
LOCK, PROGRESS, STOP = "run.lock", "progress.json", "stop"  # files in a run folder, as in backend/refgs/lock.py
LOGS = "logs"  # folder among the runs of a batch that has these files of it, as in backend/refgs/batch/listing.py


@dataclass
class Job:
    """Store the commands for one worker process, in order, and what the process has reported so far.

    `state` is "waiting" (for earlier jobs), "starting", "running", "paused", "done", "cancelled" or "failed". A job without commands starts
    the worker only to learn the trainer's version.
    """

    name: str
    python: Path
    commands: list[dict]
    log: Path
    run: Path | None = None  # run folder that the job works in, or a batch's LOGS; such jobs run one at a time
    arguments: tuple[str, ...] = ("-E", "-P", "-m", "refgs.cli", "worker")  # of that Python
    program: str = TRAINER
    state: str = "waiting"
    line: str = ""  # current step; at the end, the error
    fraction: float = 0.0  # of the current step, where a stage event has it, or of the mesh after a training
    warnings: list[str] = field(default_factory=list)
    decided: dict[str, str] = field(default_factory=dict)  # result and reason of each automatic setting
    masked: Callable[[dict], None] | None = None  # called with the event that tells that a training has made masks
    progress: dict = field(default_factory=dict)  # newest event; so are the next two
    preview: dict = field(default_factory=dict)
    ready: dict = field(default_factory=dict)
    results: dict[str, dict] = field(default_factory=dict)  # "done" events by command
    no_cameras: bool = False  # failed because the photos have no cameras: `find_cameras` finds them
    curve: list[tuple[float, float]] = field(default_factory=list)  # seconds, PSNR of the training views
    held_out: list[tuple[float, float]] = field(default_factory=list)  # seconds, PSNR of the held-out views
    serial: int = field(default_factory=count(1).__next__)  # unique, and never 0
    kept: bool = False  # finishes even if Blender closes
    then: Callable[["Job"], None] | None = None  # called once, when the job is done
    _stopped: bool = False
    _output_closed: bool = False
    _query_only: bool = False
    _process: subprocess.Popen | None = None
    _events: queue.SimpleQueue = field(default_factory=queue.SimpleQueue)

    @property
    def kind(self) -> str:
        """Return the first command's name, such as "train". Return "" if the job only learns the trainer's version."""
        return self.commands[0]["command"] if self.commands else ""

    @property
    def ended(self) -> bool:
        return self.state in ENDED

    @property
    def active(self) -> bool:
        """Return True from the start of the job's process until the job has ended, also while it is paused."""
        return not self.ended and self.state != "waiting"

    def start(self) -> None:
        """Start the process. If that fails, the job's state becomes "failed"."""
        self.state, self.line = "starting", "Starting"
        try:
            self.log.parent.mkdir(parents=True, exist_ok=True)
            with open(self.log, "wb") as log:
                self._process = subprocess.Popen(
                    [str(self.python), *self.arguments],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    cwd=self.log.parent,
                    start_new_session=True,  # Ctrl-C in Blender's terminal must not reach it
                    creationflags=subprocess.CREATE_NO_WINDOW if sys.platform == "win32" else 0,
                )
        except OSError as error:
            self._fail(f"{self.python} cannot be started ({error.strerror}): choose another Python in the preferences")
            return
        threading.Thread(target=_read_events, args=(self._process, self._events), daemon=True).start()
        if self.kept:
            self.tell("keep", on=True)
        for command in self.commands:  # all at once: a kept job cannot get the next one later
            self.tell(**command)
        if not self.commands:
            self._query_only = True
            self._close()

    def tell(self, command: str, **facts) -> None:
        """Send a command with its arguments (`facts`) to the process, as one line of JSON.

        Write errors are ignored: they mean that the process has ended, and `poll` reports its end.
        """
        with contextlib.suppress(OSError, ValueError):
            self._process.stdin.write(json.dumps({"command": command} | facts).encode() + b"\n")
            self._process.stdin.flush()

    def keep(self, on: bool) -> None:
        """Choose whether the job continues after Blender closes. A job that still waits when Blender closes never starts."""
        self.kept = on
        if self.active:
            self.tell("keep", on=on)

    def poll(self) -> bool:
        """Handle the process's new events. Returns True if there were any."""
        heard = False
        while not self._events.empty():
            heard, event = True, self._events.get()
            if event is None:
                self._output_closed = True
            elif not self.ended:
                try:
                    self._handle(event)
                except (KeyError, TypeError, AttributeError):  # from a program with another protocol
                    self.warnings.append(f"not an event: {event}")
        # Output closes some time before the process ends, as torch is slow to exit: do not wait for it.
        if self._output_closed and (status := self._process.poll()) is not None:
            heard, self._output_closed = True, False
            self._process_ended(status)
        if self.state == "done" and self.then is not None:
            then, self.then = self.then, None
            try:
                then(self)
            except InputError as error:
                self.warnings.append(str(error))
        return heard

    def _handle(self, event: dict) -> None:
        match event.get("event"):
            case "ready":
                self.ready = event
                if event["protocol"] != PROTOCOL:
                    age = "older" if event["protocol"] < PROTOCOL else "newer"
                    self._fail(f"the trainer, {event['refgs']}, is {age} than this add-on: install the same release")
            case "started":
                self.state, self.line = "running", _FIRST.get(event["job"], "")
            case "stage" | "decided" if event.get("detail"):  # for the run's log.txt alone
                pass
            case "stage":
                self.line, self.fraction = event["what"], event.get("part", self.fraction)
            case "warning":
                self.warnings.append(event["what"])
            case "decided":
                self.decided[event["about"]] = event["what"]
            case "masks":  # that a training made before it began
                self.decided["masks"], self.progress = event["what"], {}
                if self.masked is not None:
                    self.masked(event)
            case "progress" if self.curve and "stage" in event:  # of the mesh: keep the training's figures
                self.line, self.fraction = "", event["done"] / event["total"]
            case "progress":
                self.progress, self.line = event, ""
                if "stage" not in event:  # of a training
                    self.curve.append((event["seconds"], event["psnr"]))
            case "measured":
                if "psnr_test" in event:
                    self.held_out.append((event["seconds"], event["psnr_test"]))
            case "preview":
                self.preview = event
            case "paused" | "resumed" as which:
                self.state = "paused" if which == "paused" else "running"
            case "done":
                self.results[event["job"]] = event
                if len(self.results) == len(self.commands):
                    self.state, self.line = "done", ""
                    self._close()
            case "cancelled":
                at = f" at iteration {event['iteration']:,}" if "iteration" in event else ""
                self.state, self.line = "cancelled", f"Stopped{at}"
                self._close()
            case "failed":
                self.no_cameras = event.get("no_cameras", False)
                self._fail(event["what"])

    def _fail(self, what: str) -> None:
        self.state, self.line = "failed", what
        self._close()

    def _close(self) -> None:
        """Make the process exit, even if the artist chose that it continues after Blender closes."""
        if self._process is not None:
            if self.kept:
                self.tell("keep", on=False)
            self.close_input()

    def close_input(self) -> None:
        """Close the process's standard input. The process then stops, unless it should continue without Blender (`keep`)."""
        with contextlib.suppress(OSError):
            self._process.stdin.close()

    def _process_ended(self, status: int) -> None:
        if self.ready and self._query_only and not self.ended:
            self.state, self.line = "done", ""
        elif self._stopped and not self.ended:
            self.state, self.line = "cancelled", "Stopped"
        elif not self.ended:
            # Linux kills the largest program when memory is full.
            killed = "killed, perhaps as memory was full; " if status == -9 else ""
            self._fail(f"{self.program} ended unexpectedly (status {status}): {killed}see its log")

    def stop(self) -> None:
        """Stop the job cleanly. A training stops after its current iteration and writes a checkpoint."""
        if self.state == "waiting":
            self.state, self.line = "cancelled", "Cancelled"
        elif not self.ended:
            self._stopped = True
            self._close()


def _read_events(process: subprocess.Popen, heard: queue.SimpleQueue) -> None:
    with process.stdout:
        for line in process.stdout:
            try:
                heard.put(json.loads(line))
            except ValueError:
                heard.put({"event": "warning", "what": line.decode(errors="replace").strip()})
    heard.put(None)


JOBS: list[Job] = []
"""Jobs of this session that have not been dismissed, oldest first. One training runs at a time."""


def find(serial: int) -> Job:
    """Find a job in the list by its `serial`. Raises InputError if it was dismissed."""
    for job in JOBS:
        if job.serial == serial:
            return job
    raise InputError("this job is no longer in the list: nothing was done")


def in_blender(name: str, blender: Path, arguments: tuple[str, ...], command: Mapping[str, object], log: Path) -> Job:
    """Start a job in another Blender process, which runs `render_worker`. It does not wait for other jobs.

    `arguments` are the command-line arguments of that Blender. `command` is one of the commands that `render_worker` lists. If the job
    renders a picture, the finished job's `results["render"]["png"]` is the picture's path.
    """
    return add(Job(name, blender, [dict(command)], log, arguments=arguments, program=BLENDER))


def add(job: Job) -> Job:
    """Add a job to the list, and start it unless it has to wait."""
    JOBS.append(job)
    poll()
    return job


def poll() -> bool:
    """Handle the new events of all jobs, and start the jobs that need not wait any longer. Returns True if anything changed."""
    changed = [job.poll() for job in JOBS]
    busy = any(job.run and job.active for job in JOBS)
    for job in JOBS:
        if job.state == "waiting" and not (job.run and busy):
            job.start()
            busy, changed = busy or job.run is not None, [True]
    return any(changed)


def trainings() -> list[Job]:
    """List the jobs that train runs or make their meshes, both running and waiting. Only these jobs can continue after Blender closes.

    Batches, which train many captures, are among them.
    """
    return [job for job in JOBS if job.run and not job.ended]


def keep_all(on: bool) -> None:
    """Choose whether all trainings continue after Blender closes. A training that still waits when Blender closes never starts."""
    for job in trainings():
        job.keep(on)


def stop_all(but: str = "") -> None:
    """Stop all jobs, except those of the kind `but`, and remove them from the list.

    Only jobs that should continue without Blender (`Job.keep`) run on.
    """
    for job in [job for job in JOBS if not but or job.kind != but]:
        if job.kept and job.active:
            job.close_input()
        else:
            job.stop()
        JOBS.remove(job)


def run_state(folder: Path) -> str:
    """Return a run folder's state.

    The state is "training" (a process works in the folder), "stopped" (the training can be resumed), "finished", or "" (no run).
    """
    if _locked(folder / LOCK):
        return "training"
    if (folder / "splats.ply").is_file():
        return "finished"
    begun = (folder / "run.toml").is_file()  # killed before its first checkpoint, it starts over
    return "stopped" if begun or any((folder / "checkpoints").glob("*.toml")) else ""


def run_progress(folder: Path) -> dict:
    """Return the progress of the training in a folder, whichever process runs it.

    The dictionary has `iteration`, `total` (the number of iterations) and `seconds_left`. It is empty before the first iteration and while
    the mesh is made.
    """
    try:
        found = read_json(folder / PROGRESS)
        known = {key: float(found[key]) for key in ("iteration", "total", "seconds_left")}
    except (InputError, KeyError, TypeError, ValueError, OverflowError):  # not there, or not by this release
        return {}
    return known if all(map(math.isfinite, known.values())) else {}


def stop_run(folder: Path) -> None:
    """Stop the training in a folder, even one that another process runs. The training can be resumed.

    Raises InputError where no training runs.
    """
    if run_state(folder) != "training":
        raise InputError(f"{folder} is not being trained")
    (folder / STOP).touch()


def stop_requested(folder: Path) -> bool:
    """Check whether a request to stop the training in this folder is pending."""
    return (folder / STOP).exists()


def _locked(file: Path) -> bool:
    """Check whether a process holds a lock on a file. The system frees the lock when that process ends.

    A file that this user may not open, such as another user's, counts as locked.
    """
    try:
        descriptor = os.open(file, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))  # a pipe is not waited for
    except PermissionError:  # another user's
        return True
    except OSError:  # usually there is no such file
        return False
    try:
        if sys.platform == "win32":
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
            msvcrt.locking(descriptor, msvcrt.LK_UNLCK, 1)
        else:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return True
    except OSError:  # a file system without locks
        return False
    finally:
        os.close(descriptor)
    return False
