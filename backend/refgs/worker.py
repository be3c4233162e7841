"""`refgs worker`: the job protocol of docs/job-protocol.md. Commands come in on stdin, events go out on stdout, a JSON object a line."""

import _thread
import json
import os
import queue
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import IO, Annotated, Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from refgs import __version__, jobs
from refgs.capture import read_capture
from refgs.capture.check import check, describe
from refgs.capture.motion import find_cameras
from refgs.errors import InputError, NoCameras
from refgs.kernels import cuda
from refgs.train.preview import write_preview
from refgs.train.state import State

PROTOCOL = 1


class _Command(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class Check(_Command):
    command: Literal["check"]
    capture: str
    out: str | None = None


class Poses(_Command):
    command: Literal["poses"]
    capture: str


class Train(_Command):
    command: Literal["train"]
    capture: str
    out: str
    preset: str | None = None
    device: str = "auto"
    minutes: Annotated[float, Field(ge=0.05)] | None = None
    settings: list[str] = []
    resume: bool = False


class Export(_Command):
    command: Literal["export"]
    run: str
    texture: Annotated[int, Field(ge=64, le=8192)] | None = None
    display_splats: str | None = None


class During(_Command):
    """What can be asked of a job while it runs. "stop" ends a training here, with its asset; "cancel" leaves it to be resumed."""

    command: Literal["preview", "pause", "resume", "stop", "cancel"]


class Keep(_Command):
    """Whether the jobs that were asked for are done to their end when the input closes. Told at any time, and heard at once."""

    command: Literal["keep"]
    on: bool


COMMANDS = TypeAdapter(Annotated[Check | Poses | Train | Export | During | Keep, Field(discriminator="command")])
CLOSED = None  # in place of a command: there will be no more of them


class Worker:
    """Does one job after another, each said to be `started`, then `done`, `cancelled` or `failed`."""

    def __init__(self, events: IO[str]):
        self._events = events
        self._commands: queue.SimpleQueue[_Command | None] = queue.SimpleQueue()  # a signal may put while it is read
        self._waiting: list[_Command] = []  # jobs that were asked for during a training
        self._open, self._deaf, self._kept = True, False, False
        self._closed = False  # no more commands will come, though some may not have been read

    def listen(self, commands: IO[str]) -> None:
        """Take commands until there are no more; in a thread of its own."""
        for line in commands:
            try:
                command = COMMANDS.validate_json(line)
                if isinstance(command, Keep):
                    self._kept = command.on
                else:
                    self._commands.put(command)
            except ValidationError as error:
                what = "; ".join(f"{'.'.join(map(str, e['loc']))} {e['msg']}".strip() for e in error.errors())
                self.say("warning", {"what": f"not a command of protocol {PROTOCOL}: {what}"})
        self.close()
        if self._deaf and not self._kept:
            _thread.interrupt_main()

    def close(self) -> None:
        """No more commands will come."""
        self._closed = True
        self._commands.put(CLOSED)

    def interrupted(self, *_) -> None:
        """End: a training after its iteration, with a checkpoint; other jobs at once, for they leave nothing half done."""
        self._kept = False
        self.close()
        if self._deaf:
            raise KeyboardInterrupt

    def say(self, event: str, facts: dict[str, Any]) -> None:
        """Send an event. Where nobody listens any more it is time to end, unless told to go on."""
        try:
            self._events.write(json.dumps({"event": event} | facts) + "\n")
            self._events.flush()
        except (OSError, ValueError):  # a broken pipe, which Windows calls an invalid argument
            if not self._kept:
                self.close()

    def run(self) -> None:
        """Work until there are no more commands."""
        why = cuda.unusable()
        card = torch.cuda.get_device_name() if why is None else None
        self.say("ready", {"protocol": PROTOCOL, "refgs": __version__, "card": card, "no_card": why})
        jobs_of = {Check: self._check, Poses: self._poses, Train: self._train, Export: self._export}
        while self._open or (self._kept and self._waiting):
            if self._waiting and self._closed and not self._kept:
                break  # what waited for the training goes with the input, wherever the training was then
            command = self._waiting.pop(0) if self._waiting else self._commands.get()
            if command is CLOSED:
                break
            if type(command) in jobs_of:
                self._do(command.command, jobs_of[type(command)], command)
            else:
                self.say("warning", {"what": f"nothing to {command.command}: no job is running"})

    def _do(self, name: str, job: Callable[[Any], tuple[str, dict]], command: _Command) -> None:
        self.say("started", {"job": name})
        self._deaf = name != "train"
        try:
            event, facts = job(command)
        except InputError as error:
            event, facts = "failed", {"what": str(error), "fault": False, "no_cameras": isinstance(error, NoCameras)}
        except Exception as error:
            traceback.print_exc()
            event, facts = "failed", {"what": f"a fault of ours: {type(error).__name__}: {error}", "fault": True}
        finally:
            self._deaf = False
        self.say(event, {"job": name} | facts)

    def _check(self, command: Check) -> tuple[str, dict]:
        capture = read_capture(Path(command.capture))
        if command.out is None:
            return "done", {"lines": describe(capture)}
        return "done", check(capture, Path(command.out))

    def _poses(self, command: Poses) -> tuple[str, dict]:
        return "done", find_cameras(Path(command.capture), self.say)

    def _train(self, command: Train) -> tuple[str, dict]:
        out = Path(command.out)
        state, quality = jobs.train(
            Path(command.capture),
            out,
            command.preset,
            command.device,
            command.minutes,
            command.settings,
            command.resume,
            self.say,
            self._attend,
        )
        facts = {"run": str(out.resolve()), "iteration": state.iteration, "seconds": state.seconds}
        if not state.ended:
            return "cancelled", facts
        needs = json.loads((out / "needs.json").read_text(encoding="utf-8"))
        left_out = [need for need in needs if not need.get("needed", False)]
        return "done", facts | {"psnr": quality, "left_out": left_out}

    def _attend(self, state: State) -> bool:
        """Do what was asked since the last iteration; True to stop here."""
        paused = False
        while paused or not self._commands.empty():
            command = self._commands.get()
            if command is CLOSED:
                self._open = False
                if not self._kept:
                    return True
                paused = False  # there is nobody to let it go on
                continue
            match command.command:
                case "pause" | "resume":
                    paused = command.command == "pause"
                    self.say("paused" if paused else "resumed", {"iteration": state.iteration})
                case "preview":
                    self.say("preview", write_preview(state))
                case "cancel":
                    return True
                case "stop":
                    state.total = state.iteration
                    return True
                case _:
                    self._waiting.append(command)
        return False

    def _export(self, command: Export) -> tuple[str, dict]:
        display = None if command.display_splats is None else Path(command.display_splats)
        run = Path(command.run)
        files = jobs.export(run, None, command.texture, None, display, overwrite=display is not None, report=self.say)
        return "done", {"mesh" if display is None else "display_splats": str(files[0].resolve())}


def work() -> None:
    """Speak the protocol on this process's stdin and stdout. Whatever else prints goes to stderr."""
    events = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    sys.stdin.reconfigure(encoding="utf-8")
    worker = Worker(events)
    for kind in (signal.SIGTERM, signal.SIGINT):
        signal.signal(kind, worker.interrupted)
    threading.Thread(target=worker.listen, args=(sys.stdin,), daemon=True).start()
    worker.run()
