"""The backend's processes: started, told and heard without the window ever waiting for them. Nothing here needs bpy.

A job is a `refgs worker` (docs/job-protocol.md) of its own. A thread reads what it says into a queue; `poll`, called now and then,
takes it from there. The process ends by itself when Blender does, for then its standard input closes; a job that is kept is one
whose process was told to go on to its end. A run folder says by a lock whether any process works in it.
"""

import contextlib
import json
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path

from . import installation
from .errors import InputError

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

PROTOCOL = 1
TRAINER, BLENDER = "the trainer", "Blender"  # the programs that jobs are done by
ENDED = ("done", "cancelled", "failed")
LOCK, PROGRESS, STOP = "run.lock", "progress.json", "stop"  # in a run folder, as in backend/refgs/lock.py


@dataclass
class Job:
    """What a worker is asked to do, one command after another, and what it has said so far.

    `state` is "waiting" (for the jobs before it), "starting", "running", "paused", or one of ENDED. With no commands it is asked for
    its version alone.
    """

    name: str
    python: Path
    commands: list[dict]
    log: Path
    run: Path | None = None  # the folder that is trained into; such jobs run one at a time
    words: tuple[str, ...] = ("-E", "-m", "refgs.cli", "worker")  # that start it in that Python
    program: str = TRAINER
    state: str = "waiting"
    line: str = ""  # what is being done; at the end, what was wrong
    part: float = 0.0  # how much of it is done, where that is said with the line
    warnings: list[str] = field(default_factory=list)
    decided: dict[str, str] = field(default_factory=dict)  # how what was left to the photos came out, and why
    progress: dict = field(default_factory=dict)  # the newest event of its kind, as are the next
    preview: dict = field(default_factory=dict)
    ready: dict = field(default_factory=dict)
    results: dict[str, dict] = field(default_factory=dict)  # "done" events by their jobs
    no_cameras: bool = False  # it failed because the capture has photos but no cameras: `poses` finds them
    curve: list[tuple[float, float]] = field(default_factory=list)  # seconds, PSNR of training views
    held_out: list[tuple[float, float]] = field(default_factory=list)  # the same of views that are not trained on
    serial: int = field(default_factory=count().__next__)  # no other job has it
    kept: bool = False  # it goes on to its end when Blender closes
    _stopped: bool = False
    _silent: bool = False  # the process says nothing more
    _asked_only: bool = False
    _process: subprocess.Popen | None = None
    _heard: queue.SimpleQueue = field(default_factory=queue.SimpleQueue)

    @property
    def ended(self) -> bool:
        return self.state in ENDED

    @property
    def active(self) -> bool:
        """Whether it has a process to do something."""
        return not self.ended and self.state != "waiting"

    def start(self) -> None:
        """Start the process; where that fails the job has failed."""
        self.state, self.line = "starting", "Starting"
        try:
            self.log.parent.mkdir(parents=True, exist_ok=True)
            with open(self.log, "wb") as log:
                self._process = subprocess.Popen(
                    [str(self.python), *self.words],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    cwd=self.log.parent,
                    start_new_session=True,  # a terminal that Blender was started from takes it along by its input alone
                    creationflags=subprocess.CREATE_NO_WINDOW if sys.platform == "win32" else 0,
                )
        except OSError as error:
            self._fail(f"{self.python} cannot be started ({error.strerror}): choose another Python in the preferences")
            return
        threading.Thread(target=_listen, args=(self._process, self._heard), daemon=True).start()
        if self.kept:
            self.tell("keep", on=True)
        for command in self.commands:  # all at once, for one that is kept has nobody to tell it the next
            self.tell(**command)
        if not self.commands:
            self._asked_only = True
            self._close()

    def tell(self, command: str, **facts) -> None:
        """Send a command. One that nobody hears is no matter: that the process has ended is heard too."""
        with contextlib.suppress(OSError, ValueError):
            self._process.stdin.write(json.dumps({"command": command} | facts).encode() + b"\n")
            self._process.stdin.flush()

    def keep(self, on: bool) -> None:
        """Have it go on to its end, or no longer, when Blender closes or is killed. One that waits still has to be started by then."""
        self.kept = on
        if self.active:
            self.tell("keep", on=on)

    def poll(self) -> bool:
        """Take in what was said since; whether that was anything."""
        heard = False
        while not self._heard.empty():
            heard, event = True, self._heard.get()
            if event is None:
                self._silent = True
            elif not self.ended:
                try:
                    self._take(event)
                except (KeyError, TypeError, AttributeError):  # from a program that speaks otherwise
                    self.warnings.append(f"not an event: {event}")
        # Silence comes a while before the end, torch being slow to go: the window does not wait for it.
        if self._silent and (status := self._process.poll()) is not None:
            heard, self._silent = True, False
            self._gone(status)
        return heard

    def _take(self, event: dict) -> None:
        match event.get("event"):
            case "ready":
                self.ready = event
                if event["protocol"] != PROTOCOL:
                    newer = "older" if event["protocol"] < PROTOCOL else "newer"
                    self._fail(f"the trainer, {event['refgs']}, is {newer} than this add-on: install the same release")
            case "started":
                self.state, self.line = "running", {"train": "Reading the photos"}.get(event["job"], "")
            case "stage":
                self.line, self.part = event["what"], event.get("part", self.part)
            case "warning":
                self.warnings.append(event["what"])
            case "decided":
                self.decided[event["about"]] = event["what"]
            case "progress" if self.curve and "stage" in event:  # of the mesh: what the training reached stays shown
                self.line = ""
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
                self.state, self.line = "cancelled", f"Stopped at iteration {event['iteration']:,}"
                self._close()
            case "failed":
                self.no_cameras = event.get("no_cameras", False)
                self._fail(event["what"])

    def _fail(self, what: str) -> None:
        self.state, self.line = "failed", what
        self._close()

    def _close(self) -> None:
        """Have the process end."""
        if self._process is not None:
            if self.kept:
                self.tell("keep", on=False)
            self.let_go()

    def let_go(self) -> None:
        """Say nothing more to the process, which ends unless the job is kept."""
        with contextlib.suppress(OSError):
            self._process.stdin.close()

    def _gone(self, status: int) -> None:
        """The process has ended."""
        if self.ready and self._asked_only and not self.ended:
            self.state, self.line = "done", ""
        elif self._stopped and not self.ended:
            self.state, self.line = "cancelled", "Stopped"
        elif not self.ended:
            self._fail(f"{self.program} ended unexpectedly (status {status}): its log says more")

    def stop(self) -> None:
        """End cleanly: a training with a checkpoint, after its iteration."""
        if self.state == "waiting":
            self.state, self.line = "cancelled", "Taken back"
        elif not self.ended:
            self._stopped = True
            self._close()


def _listen(process: subprocess.Popen, heard: queue.SimpleQueue) -> None:
    with process.stdout:
        for line in process.stdout:
            try:
                heard.put(json.loads(line))
            except ValueError:
                heard.put({"event": "warning", "what": line.decode(errors="replace").strip()})
    heard.put(None)


JOBS: list[Job] = []
"""All jobs of this session that have not been put away, the oldest first. Of those that train one runs at a time."""


def check(python: Path, capture: Path, out: Path, log: Path) -> Job:
    """Have a capture read, beside whatever else runs. `results["check"]` has `lines` about it, its `cameras` and `thumbnails`, which are
    written into the folder `out`, and more: docs/job-protocol.md."""
    return _add(Job(capture.name, python, [_check(capture, out)], log))


def poses(python: Path, capture: Path, out: Path, log: Path) -> Job:
    """Have the cameras of a folder's photos found, then have it read as `check` does, beside whatever else runs."""
    return _add(Job(capture.name, python, [{"command": "poses", "capture": str(capture)}, _check(capture, out)], log))


def _check(capture: Path, out: Path) -> dict:
    return {"command": "check", "capture": str(capture), "out": str(out)}


def ask(python: Path, log: Path) -> Job:
    """Ask a Python whether RefGS's trainer is in it, which one, and what it would train on: `ready`, when the job is done."""
    return _add(Job("trainer", python, [], log))


def install(home: Path, log: Path) -> Job:
    """Install the trainer that the add-on brings into an environment of its own, or go on with that: `ready`, when the job is done."""
    words = {"uv": str(installation.wheel("uv")), "trainer": str(installation.wheel("refgs"))}
    return _by_blender("install", home, log, words)


def remove(home: Path, log: Path) -> Job:
    """Remove that environment, or what there is of it."""
    return _by_blender("remove", home, log, {})


def _by_blender(command: str, home: Path, log: Path, words: dict[str, str]) -> Job:
    """By Blender's own Python, which needs nothing but its own library for it."""
    told = {"command": command, "home": str(home)} | words
    return _add(Job(command, Path(sys.executable), [told], log, words=("-I", installation.__file__)))


def train(
    python: Path,
    capture: Path,
    out: Path,
    log: Path,
    *,
    preset: str | None = None,
    minutes: float | None = None,
    settings: Mapping[str, object] | None = None,
    mesh: bool = True,
    resume: bool = False,
) -> Job:
    """Train a capture into a run folder, and make its mesh, after the jobs that wait already.

    Without a preset all is chosen for the minutes; without either it is the standard one. `settings` are those of a preset by their
    names, `{"train.iterations": 2000}`. Raises InputError where there is nothing to train from, or a run in the folder already.
    """
    if not capture.is_dir():
        raise InputError(f"{capture} is not a folder: choose the folder of a capture")
    if not resume and out.exists() and any(out.iterdir()):
        raise InputError(f"{out} is not empty: choose another folder for the run")
    if any(job.run == out and not job.ended for job in JOBS):
        raise InputError(f"{out} is being trained already")
    words = {"preset": preset, "minutes": minutes, "settings": [f"{k}={v}" for k, v in (settings or {}).items()]}
    if resume:
        words = {"minutes": minutes, "resume": True}
    commands = [{"command": "train", "capture": str(capture), "out": str(out)} | words]
    if mesh:
        commands.append({"command": "export", "run": str(out)})
    return _add(Job(out.name, python, commands, log, out))


def export(python: Path, run: Path, log: Path) -> Job:
    """Make the mesh and the textures of a run, after the jobs that wait already."""
    return _add(Job(run.name, python, [{"command": "export", "run": str(run)}], log, run))


def display_splats(python: Path, run: Path, file: Path, log: Path) -> Job:
    """Have a run written as splats for viewers that know no light, in place of what the file holds, beside whatever else runs."""
    command = {"command": "export", "run": str(run), "display_splats": str(file)}
    return _add(Job(file.name, python, [command], log))


def render(blender: Path, words: tuple[str, ...], command: Mapping[str, object], log: Path) -> Job:
    """Have another Blender render, as `background.main` says, beside whatever else runs; the picture is `results["render"]["png"]`."""
    return _add(Job(Path(command["png"]).name, blender, [dict(command)], log, words=words, program=BLENDER))


def _add(job: Job) -> Job:
    JOBS.append(job)
    poll()
    return job


def poll() -> bool:
    """Take in what all jobs have said, start the one whose turn it is; whether anything changed."""
    changed = [job.poll() for job in JOBS]
    busy = any(job.run and job.active for job in JOBS)
    for job in JOBS:
        if job.state == "waiting" and not (job.run and busy):
            job.start()
            busy, changed = busy or job.run is not None, [True]
    return any(changed)


def trainings() -> list[Job]:
    """Jobs that work in a run folder, or wait to: those that can be kept."""
    return [job for job in JOBS if job.run and not job.ended]


def keep_all(on: bool) -> None:
    """Have all trainings go on when Blender closes, or none. Those that wait for another by then have not begun, and do not."""
    for job in trainings():
        job.keep(on)


def stop_all() -> None:
    """End everything cleanly but what is kept, and forget it."""
    for job in JOBS:
        if job.kept and job.active:
            job.let_go()
        else:
            job.stop()
    JOBS.clear()


def run_state(folder: Path) -> str:
    """What a run folder holds: "training" (a process works in it), "finished", "stopped" (it can be gone on with), or "" where it is
    none."""
    if _locked(folder / LOCK):
        return "training"
    if (folder / "splats.ply").is_file():
        return "finished"
    notes = folder / "checkpoints"
    return "stopped" if notes.is_dir() and any(file.endswith(".toml") for file in os.listdir(notes)) else ""


def run_progress(folder: Path) -> dict:
    """How far the training in a folder is, whichever process trains: `iteration`, `total`, `seconds_left`. Empty where it says nothing
    yet, or makes the mesh by now."""
    try:
        return json.loads((folder / PROGRESS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def stop_run(folder: Path) -> None:
    """Have the process that trains in a folder stop, whoever started it; the training can be gone on with. Raises InputError where
    there is none."""
    if run_state(folder) != "training":
        raise InputError(f"{folder} is not being trained")
    (folder / STOP).touch()


def stops(folder: Path) -> bool:
    """Whether the training in a folder has been asked to stop."""
    return (folder / STOP).exists()


def _locked(file: Path) -> bool:
    """Whether a process holds a lock on the first byte of a file. It goes with the process, however that ends."""
    try:
        descriptor = os.open(file, os.O_RDONLY)
    except OSError:  # mostly that there is none
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
