"""Read the trainings of a batch from a list of captures and settings, or from a folder of captures, and check them before they start."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from refgs.capture import find_layout
from refgs.capture.files import find_photos
from refgs.errors import InputError
from refgs.formats.validate import read_toml
from refgs.settings import Settings, load_settings

LOGS = "logs"  # the folder in RUNS that holds what the steps print, and how they ended
LIBRARY = "library"  # the folder in RUNS in which Blender makes the runs assets


class Ask(BaseModel):
    """Hold the options of `refgs train` that one level of a batch gives.

    The levels are, from top to bottom: the command line, a list, an entry of the list's `settings`, an entry of the list's `captures`. If
    `preset` or `minutes` is None, the level above gives the value. `set` adds to the `set` options of the level above (see `under`).
    """

    model_config = ConfigDict(extra="forbid", strict=True)
    preset: str | None = None
    minutes: Annotated[float, Field(ge=0.05)] | None = None
    set: list[str] = []

    def under(self, above: "Ask") -> "Ask":
        """Return these options, completed by the options of the level `above`.

        `preset` and `minutes` are taken from `above` if they are None here. The `set` options are those of `above`, followed by those of
        this level.
        """
        preset, minutes = self.preset or above.preset, self.minutes or above.minutes
        return Ask(preset=preset, minutes=minutes, set=[*above.set, *self.set])


class _CaptureLine(Ask):
    folder: str
    name: str | None = None


class _SettingsLine(Ask):
    name: str


class _List(Ask):
    include: list[str] = []
    captures: list[_CaptureLine] = []
    settings: list[_SettingsLine] = []


class Job(NamedTuple):
    """Describe a training of the batch.

    - `name`: the name of its run folder
    - `capture`: the capture's folder
    - `capture_name`: the name of the capture. All trainings of a capture share the steps that find cameras and make masks. The logs of
      these steps are kept under this name.
    - `ask`: the options of the training
    """

    name: str
    capture: Path
    capture_name: str
    ask: Ask

    def settings(self) -> Settings:
        """Load the training's settings, or the preset `standard` if they will be chosen later."""
        return load_settings(self.ask.preset or "standard", self.ask.set)


def read_jobs(source: Path, out: Path, ask: Ask) -> list[Job]:
    """Read the trainings of a batch from a list or from a folder of captures, and check them.

    `ask` holds the options of the command line, which apply where the list has none. Raises InputError if a capture is listed twice, if two
    trainings would have one run folder, if a folder is missing, if lists include each other in a circle, or if settings are wrong.
    """
    jobs = list(_jobs_of_folder(source, out, ask) if os.path.isdir(source) else _jobs_of_list(source, ask, ()))
    if not jobs:
        raise InputError(f"{source}: no captures in it: put each into a folder of its own, or list them")
    _check_unique(source, out, jobs)
    for how in {repr(job.ask): job for job in jobs}.values():
        try:
            how.settings()
        except InputError as error:
            raise InputError(f"{source}: {how.name}: {error}") from None
    return jobs


def _jobs_of_folder(source: Path, out: Path, ask: Ask) -> Iterator[Job]:
    if find_layout(source) is not None or find_photos(source):
        raise InputError(f"{source} is a capture itself: name the folder that it is in, or take refgs train")
    for folder in sorted(source.iterdir()):
        if folder.is_dir() and not folder.name.startswith("."):
            if folder.resolve() == out.resolve():
                raise InputError(f"--out {out} is in the folder of the captures: choose another place for the runs")
            yield Job(folder.name, folder.resolve(), folder.name, ask)


def _jobs_of_list(file: Path, ask: Ask, above: tuple[Path, ...]) -> Iterator[Job]:
    """Yield the trainings of a list and of the lists that it includes."""
    file = Path(os.path.realpath(file))
    if file in above:
        raise InputError(f"{above[-1]} includes {file}, which includes it: take one of them out")
    found = read_toml(file, _List, "Name a list of captures, docs/batch.md says how, or the folder that they are in.")
    for name in found.include:
        yield from _jobs_of_list(_beside(file, name), ask, (*above, file))
    whole = found.under(ask)
    for line in found.captures:
        folder = _beside(file, line.folder)
        if not os.path.isdir(folder):
            raise InputError(f"{file}: {line.folder}: there is no such folder")
        name = line.name or folder.name
        if not found.settings:
            yield Job(name, folder, name, line.under(whole))
        for settings in found.settings:
            yield Job(f"{name}-{settings.name}", folder, name, line.under(settings.under(whole)))


def _beside(file: Path, name: str) -> Path:
    """Return the absolute path of `name`, which is relative to the folder of `file`."""
    if "\0" in name:
        raise InputError(f"{file}: {name!r} is no path: correct the list")
    return Path(os.path.realpath(file.parent / name))  # and not Path.resolve, which raises for names that are too long


def _check_unique(source: Path, out: Path, jobs: list[Job]) -> None:
    """Raise InputError for invalid names, captures listed twice, and run folders used twice."""
    names: dict[Path, str] = {}
    runs: dict[str, Job] = {}
    for job in jobs:
        for name in (job.name, job.capture_name):
            if name.lower() in (LOGS, LIBRARY) or name.startswith(".") or any(c in name for c in '/\\:*?"<>|'):
                raise InputError(f"{source}: {name!r} cannot be the name of a run's folder: give the capture another")
        if (other := runs.setdefault(job.name.lower(), job)) is not job:
            if other.capture == job.capture:
                raise InputError(f"{source}: {job.capture} is listed twice: take one line out, or use [[settings]]")
            both = f"{other.capture} and {job.capture}"
            raise InputError(f"{source}: {both} would both be trained into {out / job.name}: give one a name")
        if names.setdefault(job.capture, job.capture_name) != job.capture_name:
            raise InputError(f"{source}: {job.capture} is listed twice: take one line out, or use [[settings]]")
