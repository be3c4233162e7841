"""Speak the job protocol (docs/job-protocol.md): read commands on stdin, write events to stdout, one JSON object a line."""

import _thread
import io
import json
import os
import queue
import signal
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Annotated, Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from refgs import __version__, train_job
from refgs.asked import Asked, check_device
from refgs.capture import read_capture
from refgs.capture.check import check, describe
from refgs.capture.masks import make_masks
from refgs.capture.motion import find_cameras
from refgs.capture.video import extract_photos
from refgs.errors import TRY_AGAIN, InputError, NoCameras, one_line
from refgs.export.export_job import export as export_run
from refgs.formats.needs import Needs
from refgs.formats.validate import read_json
from refgs.kernels import cuda
from refgs.memory import shortage_named
from refgs.paths import disk_errors_named
from refgs.settings import load_settings
from refgs.train.keep.live_view import write_preview
from refgs.train.state import State

PROTOCOL = 1


class _Command(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class Check(_Command):
    command: Literal["check"]
    capture: str
    out: str | None = None


class Frames(_Command):
    command: Literal["frames"]
    video: str
    out: str
    count: Annotated[int, Field(ge=3, le=1000)] = 100


class Poses(_Command):
    command: Literal["poses"]
    capture: str


class Masks(_Command):
    command: Literal["masks"]
    capture: str
    settings: list[str] = []
    model: str | None = None


class Train(_Command):
    command: Literal["train"]
    capture: str
    out: str
    preset: str | None = None
    device: str = "auto"
    minutes: Annotated[float, Field(ge=0.05, allow_inf_nan=False)] | None = None
    settings: list[str] = []
    resume: bool = False
    run: Annotated[str | None, Field(alias="from")] = None
    hints: str | None = None

    def asked(self) -> Asked:
        """Return the command's options. Raises InputError if they are wrong or do not fit."""
        run, hints = (Path(path) if path else None for path in (self.run, self.hints))
        changes = tuple(self.settings)
        return Asked(
            Path(self.capture), Path(self.out), self.preset, self.device, self.minutes, changes, self.resume, run, hints
        )


class Export(_Command):
    command: Literal["export"]
    run: str
    texture: Annotated[int, Field(ge=64, le=8192)] | None = None
    display_splats: str | None = None


class Batch(_Command):
    command: Literal["batch"]
    captures: str
    out: str
    preset: str | None = None
    device: str = "auto"


class During(_Command):
    """Command to the job that is running.

    Two commands end a training: "stop" writes its results, "cancel" writes only a checkpoint, from which it can be resumed. Both stop a
    batch, whose trainings write checkpoints.
    """

    command: Literal["preview", "pause", "resume", "stop", "cancel"]


class Keep(_Command):
    """Command that sets what happens to jobs when the input ends: they continue if `on` is True, otherwise they are ended.

    It takes effect at once, even while a job is running.
    """

    command: Literal["keep"]
    on: bool


COMMANDS = TypeAdapter(
    Annotated[Check | Frames | Poses | Masks | Train | Export | Batch | During | Keep, Field(discriminator="command")]
)
JOBS = (Check, Frames, Poses, Masks, Train, Export, Batch)
CLOSED = None  # queued in place of a command: the input has ended


@dataclass
class Refused:
    """Hold why an input line is no valid command (`what`), and its `job`, if known."""

    job: str | None
    what: str


def read_command(line: bytes) -> _Command | Refused:
    """Parse a line of the input to its command, or to a `Refused`."""
    job = None
    try:
        message = json.loads(line.decode())  # pydantic's parser refuses lone surrogates: names of folders hold them
        name = message.get("command") if isinstance(message, dict) else None
        job = next((kind.__name__.lower() for kind in JOBS if name == kind.__name__.lower()), None)
        return COMMANDS.validate_python(message)
    except ValidationError as error:
        what = "; ".join(f"{'.'.join(map(str, e['loc']))} {e['msg']}".strip() for e in error.errors())
    except (ValueError, RecursionError) as error:  # no UTF-8, no JSON, or too deep
        what = str(error)
    return Refused(job, f"not a command of protocol {PROTOCOL}: {what}")


class _Ended(Exception):
    """Raised to end a training before its first iteration, while it makes masks."""


class Worker:
    """Run jobs (check, frames, poses, masks, train, export, batch) one after another, as commands ask for them.

    Each job sends the event `started`, and at its end `done`, `cancelled` or `failed`.
    """

    def __init__(self, events: IO[str]):
        self._events = events
        # A signal handler may put while the queue is read: only SimpleQueue allows that.
        self._commands: queue.SimpleQueue[_Command | Refused | None] = queue.SimpleQueue()
        self._waiting: list[_Command | Refused] = []  # jobs that came during a training
        self._keep = False  # run jobs to their end after the input has closed
        self._attentive = True  # no job runs that cannot read commands
        self._open = True  # CLOSED has not been taken from the queue
        self._blind = False  # a warning has said that no preview can be written
        self._closed = False  # the input has ended; commands may still be queued

    def listen(self, commands: IO[bytes]) -> None:
        """Read commands from the input and queue them, until the input ends. Runs in its own thread.

        `Keep` commands take effect at once. When the input ends, a job that cannot read commands is interrupted, unless `Keep` is on.
        """
        try:
            for line in commands:
                command = read_command(line)
                if isinstance(command, Keep):
                    self._keep = command.on
                else:
                    self._commands.put(command)
        finally:
            self.close()
        if not self._attentive and not self._keep:
            _thread.interrupt_main()

    def close(self) -> None:
        """Note that the input has ended and no more commands will come."""
        self._closed = True
        self._commands.put(CLOSED)

    def interrupt(self, *_) -> None:
        """Handle SIGTERM and SIGINT: a training ends with a checkpoint, other jobs at once."""
        self._keep = False
        self.close()
        if not self._attentive:
            raise KeyboardInterrupt

    def take_signals(self) -> None:
        """Let `interrupt` handle SIGTERM and SIGINT."""
        for kind in (signal.SIGTERM, signal.SIGINT):
            signal.signal(kind, self.interrupt)

    def send(self, event: str, facts: dict[str, Any]) -> None:
        """Write an event to the output as a JSON line.

        If `facts` has a message `what`, its newlines are escaped. If nobody reads the output any more, this counts as the end of the input,
        unless the last `Keep` command had `on` = True.
        """
        if "what" in facts:
            facts = facts | {"what": one_line(facts["what"])}
        try:
            self._events.write(json.dumps({"event": event} | facts) + "\n")
            self._events.flush()
        except (OSError, ValueError):  # broken pipe; Windows reports an invalid argument
            if not self._keep:
                self.close()

    def run(self) -> None:
        """Send the event `ready`, then run jobs until no more commands can come."""
        why = cuda.unusable()
        card = torch.cuda.get_device_name() if why is None else None
        self.send("ready", {"protocol": PROTOCOL, "refgs": __version__, "card": card, "no_card": why})
        jobs = (self._check, self._frames, self._poses, self._masks, self._train, self._export, self._batch)
        jobs_of = dict(zip(JOBS, jobs, strict=True))
        while self._open or (self._keep and self._waiting):
            if self._waiting and self._closed and not self._keep:
                break  # the input has ended: drop the jobs that came during the training
            command = self._waiting.pop(0) if self._waiting else self._commands.get()
            if command is CLOSED:
                break
            if type(command) in jobs_of:
                self._run_job(command.command, jobs_of[type(command)], command)
            elif isinstance(command, Refused):
                self.send("failed", {"job": command.job, "what": command.what, "fault": False, "no_cameras": False})
            else:
                self.send("warning", {"what": f"nothing to {command.command}: no job is running"})

    def _run_job(self, name: str, job: Callable[[Any], tuple[str, dict]], command: _Command) -> None:
        self.send("started", {"job": name})
        self._attentive = name in ("train", "batch")
        try:
            with shortage_named(), disk_errors_named([], "start the job again"):
                event, facts = job(command)
        except InputError as error:
            event, facts = "failed", {"what": str(error), "fault": False, "no_cameras": isinstance(error, NoCameras)}
        except Exception as error:
            traceback.print_exc()
            event, facts = "failed", {"what": f"a fault of ours: {type(error).__name__}: {error}", "fault": True}
        finally:
            self._attentive = True
        self.send(event, {"job": name} | facts)

    def _check(self, command: Check) -> tuple[str, dict]:
        capture = read_capture(Path(command.capture))
        if command.out is None:
            return "done", {"lines": describe(capture)}
        return "done", check(capture, Path(command.out))

    def _frames(self, command: Frames) -> tuple[str, dict]:
        out = Path(command.out)
        found = extract_photos(Path(command.video), out, command.count, self.send)
        return "done", found | {"capture": str(out.resolve())}

    def _poses(self, command: Poses) -> tuple[str, dict]:
        return "done", find_cameras(Path(command.capture), self.send)

    def _masks(self, command: Masks) -> tuple[str, dict]:
        region = load_settings("standard", command.settings).region
        folder = Path(command.capture)
        model = Path(command.model) if command.model else None
        return "done", make_masks(folder, region, self.send, model) | {"capture": str(folder.resolve())}

    def _train(self, command: Train) -> tuple[str, dict]:
        asked = command.asked()
        facts = {"run": str(asked.out.resolve()), "iteration": 0, "seconds": 0.0}
        try:
            state, quality = train_job.train(asked, self._hear_training, self._attend)
        except _Ended:
            return "cancelled", facts
        facts |= {"iteration": state.iteration, "seconds": state.seconds}
        if not state.ended:
            return "cancelled", facts
        needs = read_json(asked.out / "needs.json", Needs, "Train again.").root
        left_out = [need.model_dump(exclude_unset=True) for need in needs if not need.needed]
        return "done", facts | {"psnr": quality, "left_out": left_out}

    def _hear_training(self, event: str, facts: dict[str, Any]) -> None:
        """Send a training's event, and handle commands while it makes masks. Raises _Ended."""
        self.send(event, facts)
        while event == "progress" and "stage" in facts and not self._commands.empty():
            command = self._commands.get()
            if command is CLOSED:
                self._open = False
                if not self._keep:
                    raise _Ended
            elif isinstance(command, During):
                if command.command in ("stop", "cancel"):
                    raise _Ended
            else:
                self._waiting.append(command)

    def _attend(self, state: State) -> bool:
        """Handle commands before an iteration, waiting while paused; return True to stop training."""
        paused = False
        while paused or not self._commands.empty():
            command = self._commands.get()
            if command is CLOSED:
                self._open = False
                if not self._keep:
                    return True
                paused = False  # nobody is left to resume it
                continue
            if not isinstance(command, During):
                self._waiting.append(command)
                continue
            match command.command:
                case "pause" | "resume":
                    paused = command.command == "pause"
                    self.send("paused" if paused else "resumed", {"iteration": state.iteration})
                case "preview":
                    self._preview(state)
                case "cancel":
                    return True
                case "stop":
                    state.total = state.iteration
                    return True
        return False

    def _preview(self, state: State) -> None:
        """Write and send a preview; warn once if it cannot be written."""
        try:
            self.send("preview", write_preview(state))
        except OSError as error:
            if not self._blind:
                self.send("warning", {"what": f"{error.filename}: the preview cannot be written ({error.strerror})"})
            self._blind = True

    def _export(self, command: Export) -> tuple[str, dict]:
        display = None if command.display_splats is None else Path(command.display_splats)
        run = Path(command.run)
        # Textures without a mesh are of an export that was killed: the mesh is written last.
        overwrite = display is not None or not (run / "mesh.glb").exists()
        files = export_run(run, None, command.texture, None, display, overwrite, report=self.send)
        return "done", {"mesh" if display is None else "display_splats": str(files[0].resolve())}

    def _batch(self, command: Batch) -> tuple[str, dict]:
        from refgs.batch.batch import ready
        from refgs.batch.listing import Ask

        check_device(command.device)
        source, out, ask = Path(command.captures), Path(command.out), Ask(preset=command.preset)
        counts = {}

        def report(event: str, facts: dict[str, Any]) -> None:
            if event == "progress":
                counts.update((key, facts[key]) for key in ("done", "total", "failed"))
                facts = {"stage": "batch"} | counts
            self.send(event, facts)

        with ready(source, out, ask, command.device, report) as run:
            self.take_signals()  # Ray took them
            status = run(self._batch_must_stop)
        return "cancelled" if status == TRY_AGAIN else "done", {"out": str(out.resolve())} | counts

    def _batch_must_stop(self) -> bool:
        """Handle commands that came during a batch. Return True if it must stop."""
        while not self._commands.empty():
            command = self._commands.get()
            if command is CLOSED:
                self._open = False
                if not self._keep:
                    return True
            elif not isinstance(command, During):
                self._waiting.append(command)
            elif command.command in ("stop", "cancel"):
                return True
            else:
                self.send("warning", {"what": f"nothing to {command.command}: a batch can only be stopped"})
        return False


def work() -> None:
    """Run the job protocol on stdin and stdout; other output goes to stderr."""
    events = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    worker = Worker(events)
    worker.take_signals()
    # Unbuffered: a buffer is locked while the thread waits for input, and Python, ending, would wait for the lock.
    commands = io.FileIO(0, closefd=False)
    threading.Thread(target=worker.listen, args=(commands,), daemon=True).start()
    worker.run()
