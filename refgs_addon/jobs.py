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

from . import installation
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


def check(python: Path, capture: Path, out: Path, log: Path) -> Job:
    """Start a job that reads all photos and cameras of a capture and reports problems. It does not wait for other jobs.

    A capture is a folder with photos. The worker writes cameras.json and thumbnails of the photos into the folder `out`. The finished job's
    `results["check"]` has `lines` (the report), `cameras`, `thumbnails` and more: docs/job-protocol.md.
    """
    return _add(Job(capture.name, python, [_check(capture, out)], log))


def extract_photos(python: Path, video: Path, out: Path, count: int, log: Path) -> Job:
    """Start a job that writes up to `count` photos from a video into the folder `out`/images. It does not wait for other jobs.

    Raises InputError if `out`/images exists.
    """
    if (out / "images").exists():
        raise InputError(f"{out / 'images'} exists: choose another folder for the photos")
    command = {"command": "frames", "video": str(video), "out": str(out), "count": count}
    return _add(Job(out.name, python, [command], log))


def make_masks(
    python: Path, capture: Path, out: Path, log: Path, settings: Mapping[str, object], model: Path | None
) -> Job:
    """Start a job that makes masks for a capture's photos, then does the same as `check`. It does not wait for other jobs.

    `settings` may have the settings of a box around the object, such as `region.size`. `model` is an ONNX file that finds the object in a
    photo; None stands for the trainer's own method. Raises InputError if another job already makes the masks of this capture.
    """
    kind = {"command": "masks", "capture": str(capture)}
    if any(not job.ended and job.commands and kind.items() <= job.commands[0].items() for job in JOBS):
        raise InputError(f"the masks of {capture.name} are being made already: wait for them, or stop that")
    command = kind | {"settings": _words(settings), "model": model and str(model)}
    return _add(Job(capture.name, python, [command, _check(capture, out)], log))


def find_cameras(python: Path, capture: Path, out: Path, log: Path) -> Job:
    """Start a job that computes the cameras from the photos in a folder, then does the same as `check`. It does not wait for other jobs."""
    return _add(Job(capture.name, python, [{"command": "poses", "capture": str(capture)}, _check(capture, out)], log))


def _words(settings: Mapping[str, object]) -> list[str]:
    return [f"{key}={value}" for key, value in settings.items()]


def _check(capture: Path, out: Path) -> dict:
    return {"command": "check", "capture": str(capture), "out": str(out)}


def query_trainer(python: Path, log: Path) -> Job:
    """Start a job that asks the trainer for its version and GPU. `python` is the Python program that has the trainer.

    When the trainer has answered, the job's `ready` has the keys `refgs` (version), `card` (the GPU's name, or None) and `no_card` (why
    there is no GPU).
    """
    return _add(Job("trainer", python, [], log))


def install(home: Path, log: Path) -> Job:
    """Start a job that installs the bundled trainer into the folder `home`, or resumes an interrupted installation.

    After the installation, the job's `ready` has the trainer's version and GPU, with the same keys as for `query_trainer`.
    """
    arguments = {"uv": str(installation.wheel("uv")), "trainer": str(installation.wheel("refgs"))}
    return _run_installation("install", home, log, arguments)


def remove(home: Path, log: Path) -> Job:
    """Start a job that removes the trainer from the folder `home`, even an incomplete one."""
    return _run_installation("remove", home, log, {})


def _run_installation(command: str, home: Path, log: Path, arguments: dict[str, str]) -> Job:
    """Start a job that runs installation.py in Blender's own Python. That file needs only the standard library."""
    commands = [{"command": command, "home": str(home)} | arguments]
    return _add(Job(command, Path(sys.executable), commands, log, arguments=("-I", installation.__file__)))


@dataclass(frozen=True)
class Asked:
    """Hold the options of a training.

    - `capture` is a folder with photos, `out` the run folder.
    - `preset` is the name of a set of settings. If it is None, the settings are chosen so that the training takes `minutes`. If both are
      None, the preset is "standard".
    - `settings` overrides single settings: `{"train.iterations": 2000}`.
    - `resume` continues a stopped training.
    - `hinted` is a pair: the folder of a finished run, and a file that says which parts of the object are metal or paint. The job then
      continues that run's training in `out`, with that run's preset and settings.
    """

    capture: Path
    out: Path
    preset: str | None = None
    minutes: float | None = None
    settings: Mapping[str, object] = field(default_factory=dict)
    resume: bool = False
    hinted: tuple[Path, Path] | None = None

    def command(self) -> dict:
        """Return the command `train` of the job protocol with these options."""
        command = {"command": "train", "capture": str(self.capture), "out": str(self.out)}
        if self.resume:
            return command | {"minutes": self.minutes, "resume": True}
        if self.hinted is not None:
            run, hints = self.hinted
            return command | {"from": str(run), "hints": str(hints)}
        return command | {"preset": self.preset, "minutes": self.minutes, "settings": _words(self.settings)}


def train(python: Path, asked: Asked, log: Path, mesh: bool = True) -> Job:
    """Start a job that trains on a capture and writes the result into a run folder.

    The job first waits until earlier trainings have ended. With `mesh`, it also makes a mesh after the training. Raises InputError if the
    capture is not a folder, if the run folder is being trained already, or if the folder of a new run is not empty.
    """
    out = asked.out
    if not asked.capture.is_dir():
        raise InputError(f"{asked.capture} is not a folder: choose the folder of a capture")
    if not asked.resume and out.exists() and any(out.iterdir()):
        raise InputError(f"{out} is not empty: choose another folder for the run")
    if any(job.run == out and not job.ended for job in JOBS):
        raise InputError(f"{out} is being trained already")
    commands = [asked.command()]
    if mesh:
        commands.append({"command": "export", "run": str(out)})
    return _add(Job(out.name, python, commands, log, out))


def train_many(python: Path, captures: Path, out: Path, log: Path, preset: str) -> Job:
    """Start a job that trains on all captures in the folder `captures`, by `refgs batch`. The runs are made in the folder `out`.

    The job first waits until earlier trainings have ended. Steps that an earlier batch completed in `out` are not repeated. Raises
    InputError if `captures` is missing, or if a batch is already running in `out`.
    """
    if not captures.exists():
        raise InputError(f"{captures} does not exist: choose the folder that the captures are in")
    if any(job.run == out / LOGS and not job.ended for job in JOBS) or run_state(out / LOGS) == "training":
        raise InputError(f"{out}: captures are being trained into it already: wait for them, or stop that")
    command = {"command": "batch", "captures": str(captures), "out": str(out), "preset": preset}
    return _add(Job(out.name, python, [command], log, out / LOGS))


def export(python: Path, run: Path, log: Path) -> Job:
    """Start a job that makes the mesh and textures of a run folder. The job waits until earlier trainings have ended."""
    return _add(Job(run.name, python, [{"command": "export", "run": str(run)}], log, run))


def display_splats(python: Path, run: Path, file: Path, log: Path) -> Job:
    """Start a job that writes a run as display splats: splats with fixed colours, for viewers without lights.

    The job does not wait for other jobs. It replaces an existing `file`.
    """
    command = {"command": "export", "run": str(run), "display_splats": str(file)}
    return _add(Job(file.name, python, [command], log))


def in_blender(name: str, blender: Path, arguments: tuple[str, ...], command: Mapping[str, object], log: Path) -> Job:
    """Start a job in another Blender process, which runs `render_worker`. It does not wait for other jobs.

    `arguments` are the command-line arguments of that Blender. `command` is one of the commands that `render_worker` lists. If the job
    renders a picture, the finished job's `results["render"]["png"]` is the picture's path.
    """
    return _add(Job(name, blender, [dict(command)], log, arguments=arguments, program=BLENDER))


def _add(job: Job) -> Job:
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


def stop_all() -> None:
    """Stop all jobs and clear the list. Only jobs that should continue without Blender (`Job.keep`) run on."""
    for job in JOBS:
        if job.kept and job.active:
            job.close_input()
        else:
            job.stop()
    JOBS.clear()


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
