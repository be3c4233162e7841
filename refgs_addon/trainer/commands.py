"""Start the trainer's jobs, each a process of its own. This module needs no bpy."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import InputError
from ..jobs import JOBS, LOGS, Job, add, run_state
from . import installation


def check(python: Path, capture: Path, out: Path, log: Path) -> Job:
    """Start a job that reads all photos and cameras of a capture and reports problems. It does not wait for other jobs.

    A capture is a folder with photos. The worker writes cameras.json and thumbnails of the photos into the folder `out`. The finished job's
    `results["check"]` has `lines` (the report), `cameras`, `thumbnails` and more: docs/job-protocol.md.
    """
    return add(Job(capture.name, python, [_check(capture, out)], log))


def extract_photos(python: Path, video: Path, out: Path, count: int, log: Path) -> Job:
    """Start a job that writes up to `count` photos from a video into the folder `out`/images. It does not wait for other jobs.

    Raises InputError if `out`/images exists.
    """
    if (out / "images").exists():
        raise InputError(f"{out / 'images'} exists: choose another folder for the photos")
    command = {"command": "frames", "video": str(video), "out": str(out), "count": count}
    return add(Job(out.name, python, [command], log))


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
    return add(Job(capture.name, python, [command, _check(capture, out)], log))


def find_cameras(python: Path, capture: Path, out: Path, log: Path) -> Job:
    """Start a job that computes the cameras from the photos in a folder, then does the same as `check`. It does not wait for other jobs."""
    return add(Job(capture.name, python, [{"command": "poses", "capture": str(capture)}, _check(capture, out)], log))


def _words(settings: Mapping[str, object]) -> list[str]:
    return [f"{key}={value}" for key, value in settings.items()]


def _check(capture: Path, out: Path) -> dict:
    return {"command": "check", "capture": str(capture), "out": str(out)}


def query_trainer(python: Path, log: Path) -> Job:
    """Start a job that asks the trainer for its version and GPU. `python` is the Python program that has the trainer.

    When the trainer has answered, the job's `ready` has the keys `refgs` (version), `card` (the GPU's name, or None) and `no_card` (why
    there is no GPU).
    """
    return add(Job("trainer", python, [], log))


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
    return add(Job(command, Path(sys.executable), commands, log, arguments=("-I", installation.__file__)))


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
    return add(Job(out.name, python, commands, log, out))


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
    return add(Job(out.name, python, [command], log, out / LOGS))


def export(python: Path, run: Path, log: Path) -> Job:
    """Start a job that makes the mesh and textures of a run folder. The job waits until earlier trainings have ended."""
    return add(Job(run.name, python, [{"command": "export", "run": str(run)}], log, run))


def display_splats(python: Path, run: Path, file: Path, log: Path) -> Job:
    """Start a job that writes a run as display splats: splats with fixed colours, for viewers without lights.

    The job does not wait for other jobs. It replaces an existing `file`.
    """
    command = {"command": "export", "run": str(run), "display_splats": str(file)}
    return add(Job(file.name, python, [command], log))
