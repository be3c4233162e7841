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
    """Hold the release that made a run. It is read before the rest of run.toml, whose format may differ in a newer release."""

    run: Maker


class Trained(Maker):
    """Hold what a run was trained on. `centre` and `radius` are its region of interest, in the run's frame."""

    capture: str
    fingerprint: str
    preset: str
    centre: Vector
    radius: Annotated[Finite, Field(gt=0)]
    bounded: bool


class Change(Model):
    """Hold a row of the table [changed]: `asked` is the user's value of a setting that the training has changed."""

    asked: Any


class RunFile(Model):
    """Hold a run.toml. The settings are checked by `refgs.settings`."""

    run: Trained
    settings: dict[str, Any]
    changed: dict[str, Change] = Field(default_factory=dict)


class Summary(Model):
    """Hold the tables [run] and [settings] of a run.toml. The report page labels runs by the values in which they differ.

    The file may come from any release, so no key is required.
    """

    run: dict[str, Value] = Field(default_factory=dict)
    settings: dict[str, dict[str, Value | list[Value]]] = Field(default_factory=dict)
