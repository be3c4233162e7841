"""Describe run.toml: how a run was trained (docs/run-folder.md)."""

from typing import Annotated, Any

from pydantic import Field

from refgs.formats.validate import Finite, Model, Vector

Release = Annotated[str, Field(pattern=r"^[0-9]{1,9}\.[0-9]{1,9}(\..*)?$")]
Value = bool | int | float | str


class Maker(Model):
    """Hold the release of RefGS that made a run."""

    refgs: Release


class Made(Model):
    """Hold the release of RefGS in a run.toml; no other key is read.

    The release is checked first, because the format of the other keys may differ in a newer release.
    """

    run: Maker


class Trained(Maker):
    """Hold the table [run] of run.toml: what a run was trained on.

    - `capture`: the folder of the photos
    - `fingerprint`: a hash of the capture, which tells whether it has changed since
    - `preset`: the name of the settings' preset
    - `centre`, `radius`: the region of interest, a ball, in the run's coordinates
    - `bounded`: true if the photos have masks of one object or surround it, false if they show a room, an open scene or one side
    """

    capture: str
    fingerprint: str
    preset: str
    centre: Vector
    radius: Annotated[Finite, Field(gt=0)]
    bounded: bool


class Change(Model):
    """Hold a setting that the training changed; `asked` is the user's value."""

    asked: Any


class RunFile(Model):
    """Hold a run.toml. The table `settings` is not checked here, but by `refgs.settings`."""

    run: Trained
    settings: dict[str, Any]
    changed: dict[str, Change] = Field(default_factory=dict)


class Summary(Model):
    """Hold the tables [run] and [settings] of a run.toml. The report page labels runs by the values in which they differ.

    The file may come from any release, so no key is required.
    """

    run: dict[str, Value] = Field(default_factory=dict)
    settings: dict[str, dict[str, Value | list[Value]]] = Field(default_factory=dict)
