"""Describe needs.json: the optional parts of a training that a scene needed, and those that were left out (docs/run-folder.md)."""

from pathlib import PurePosixPath
from typing import Annotated, Any

from pydantic import AfterValidator, ConfigDict, Field, RootModel, ValidationError, field_validator

from refgs.formats.validate import Finite, Model


def _inside(path: str) -> str:
    parts = PurePosixPath(path).parts
    if not parts or parts[0] == "/" or ".." in parts or any(sign in path for sign in ":\\\0"):
        raise ValueError("is not a path in the run folder")
    return path


Inside = Annotated[str, AfterValidator(_inside)]
"""Path of a file in the run folder, relative to it, with forward slashes. No file elsewhere can be named: a page may show its content."""


class Pictures(Model):
    """Name three pictures of a view: with an optional part of the training (`on`), without it (`off`), and the photo.

    The pictures are files in the run folder. PSNRs are against the photo, in dB.
    """

    on: Inside
    off: Inside
    photo: Inside
    view: str
    psnr_on: Finite
    psnr_off: Finite


class Found(Model):
    """Hold the decision about an optional part of a training, as checkpoints keep it.

    `statistic` was compared with `threshold`. Leaving the part out saves `seconds` and `megabytes`, and costs `decibels` of PSNR on the
    training views. `side` is the reduced resolution for the part `light`, `total` the reduced number of iterations for `iterations`. A
    matte scene is measured a second time, halfway through the training; `again` is the result.
    """

    needed: bool
    why: str
    statistic: Finite | None = None
    threshold: Finite | None = None
    seconds: Finite | None = None
    megabytes: Finite | None = None
    decibels: Finite | None = None
    side: Annotated[Finite, Field(ge=0)] | None = None
    total: Annotated[Finite, Field(ge=0)] | None = None
    again: Finite | None = None
    pictures: Pictures | None = None


class Row(Model):
    """Hold a row of needs.json: an optional part (`what`), `why` it was kept or left out, what leaving it out `saved`, and its `cost`."""

    model_config = ConfigDict(extra="allow")  # the figures behind the words

    what: str
    why: str
    needed: bool = False
    saved: str = ""
    cost: str = ""
    pictures: Pictures | None = None

    @field_validator("pictures", mode="wrap")
    @classmethod
    def _whole(cls, value: Any, handler: Any) -> Pictures | None:
        """Replace incomplete pictures by None, because a row is useful without pictures."""
        try:
            return handler(value)
        except ValidationError:
            return None


class Needs(RootModel[list[Row]]):
    """Hold a needs.json."""

    model_config = ConfigDict(frozen=True)
