"""Define the request for a training. The command line, the job protocol and batches make one, and `refgs.train_job` carries it out."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from refgs.errors import InputError
from refgs.settings import Assignment, Settings, parse_change, preset_settings


@dataclass(frozen=True)
class Asked:
    """Hold the request for a training, as `refgs train` takes it. Raises InputError if values are wrong or exclude each other.

    - `capture` is the folder of photos and cameras, `out` the run folder.
    - `minutes` limits the whole job; pauses do not count. Without a `preset`, all settings are chosen to fit into that time. If neither
      `preset` nor `minutes` is given, the preset is `standard`.
    - `device` is `auto`, `cpu` or `cuda`.
    - `changes` are settings that differ from the preset's, each written `section.key=value`.
    - `resume` continues the stopped training in `out`, with that training's settings.
    - `run` is a finished run. Its training is continued in `out`, with its settings. `hints` is the file that says which parts of the run's
      surface are metal or paint.
    """

    capture: Path
    out: Path
    preset: str | None = None
    device: str = "auto"
    minutes: float | None = None
    changes: tuple[str, ...] = ()
    resume: bool = False
    run: Path | None = None
    hints: Path | None = None

    def __post_init__(self) -> None:
        check_device(self.device)
        if self.minutes is not None and not math.isfinite(self.minutes):
            raise InputError(f"--minutes {self.minutes}: take a number of minutes, e.g. 5")
        if (self.run is None) != (self.hints is None):
            raise InputError("--from and --hints go together: a finished run, and a file that says what its parts are")
        if self.resume and self.hints is not None:
            raise InputError("--resume continues the run in --out, which knows its hints: leave out --from and --hints")
        if self.resume and self.changes:
            raise InputError("--set cannot change a run that is resumed: train into a new folder")
        if self.hints is not None and (self.changes or self.preset):
            raise InputError(
                "--set and --preset cannot change a run that is continued with hints: it keeps its settings"
            )

    @property
    def planned(self) -> bool:
        """Return True if all settings are chosen to fit into `minutes`."""
        return self.preset is None and self.minutes is not None and self.hints is None

    @property
    def preset_name(self) -> str:
        """Return the preset's name for run.toml, or the time limit, such as "5 minutes"."""
        return f"{self.minutes:g} minutes" if self.planned else self.preset or "standard"

    @cached_property
    def _assignments(self) -> list[Assignment]:
        return [parse_change(change) for change in self.changes]

    def settings(self, preset: str | None = None) -> Settings:
        """Load the preset with the changes. `preset` replaces the preset asked for. Raises InputError if a setting is wrong.

        If no preset is given, `standard` is loaded. This is also the case when settings will be chosen later to fit into `minutes`.
        """
        return preset_settings(preset or self.preset or "standard", self._assignments)

    def resumed(self) -> "Asked":
        """Return a copy that asks to resume this training, without settings and hints."""
        return replace(self, changes=(), resume=True, run=None, hints=None)

    def words(self) -> list[str]:
        """Return the command-line arguments that ask for this training, without the program's name `refgs`."""
        words = ["train", str(self.capture), "--out", str(self.out), "--device", self.device]
        if self.preset:
            words += ["--preset", self.preset]
        if self.minutes:
            words += ["--minutes", f"{self.minutes:g}"]
        words += [word for change in self.changes for word in ("--set", change)]
        words += ["--resume"] if self.resume else []
        return [*words, "--from", str(self.run), "--hints", str(self.hints)] if self.hints else words


def check_device(device: str) -> None:
    """Raise InputError unless `device` is one that `--device` takes."""
    if device not in ("auto", "cpu", "cuda"):
        raise InputError(f"--device {device}: take auto, cpu or cuda")
