"""Describe the TOML file of a checkpoint: all that the next iteration depends on, except the tensors."""

from typing import Annotated

from pydantic import Field

from refgs.formats.needs import Found
from refgs.formats.validate import Finite, Model

Count = Annotated[int, Field(ge=0, le=10**9, strict=True)]
Seconds = Annotated[Finite, Field(ge=0)]


class Facts(Model):
    """Hold everything in a checkpoint except its tensors.

    `parts` maps the name of each `refgs.train.part.Part` to its facts. `clock` maps each part of an iteration to the seconds spent in it.
    """

    iteration: Count
    total: Count
    seconds: Seconds
    initial: bool | None = None  # 0.1.0 had no such stage
    residual: bool
    spent: Seconds
    processor_seconds: Seconds
    decided: dict[str, str]
    clock: dict[str, Finite]
    needs: dict[str, Found]
    parts: dict[str, dict[str, bool | Count]]
