"""Describe needs.json: which optional parts of a training, such as inter-reflection, were kept or left out (docs/run-folder.md)."""

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
    """Name the pictures that show what an optional part of the training does in one view, with their PSNR.

    - `on`, `off`, `photo`: files in the run folder: the view rendered with the part, rendered without it, and the photo
    - `view`: the view's name
    - `psnr_on`, `psnr_off`: PSNR of the two rendered pictures against the photo, in dB
    """

    on: Inside
    off: Inside
    photo: Inside
    view: str
    psnr_on: Finite
    psnr_off: Finite


class Found(Model):
    """Hold the decision whether a scene needs an optional part of the training. Checkpoints store it.

    - `needed`, `why`: the decision, and its reason in words
    - `statistic`, `threshold`: the measured value, and the value that it was compared with
    - `seconds`, `megabytes`: what leaving the part out saves
    - `decibels`: what leaving the part out costs, in PSNR on the training views
    - `side`: the reduced side of the light's cubemap, in texels; only for the part "light"
    - `total`: the reduced number of iterations; only for the part "iterations"
    - `again`: how much colours change with the view (0..1), measured halfway through the training. Only for the part "specular", in scenes
      that were judged matte at first.
    - `pictures`: renderings with and without the part, or None
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
    """Hold a row of needs.json, about an optional part of the training.

    - `what`, `why`: the part, and why it was kept or left out, in words
    - `needed`: true if the part was kept
    - `saved`, `cost`: what leaving it out saved and cost, in words
    - `pictures`: renderings with and without the part, or None
    """

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
    """Hold needs.json: a row for each optional training part that was decided about."""

    model_config = ConfigDict(frozen=True)
