"""Describe the TOML file of a checkpoint: all that the next iteration depends on, except the tensors."""

from typing import Annotated

from pydantic import Field

from refgs.formats.needs import Found
from refgs.formats.validate import Finite, Model

Count = Annotated[int, Field(ge=0, le=10**9, strict=True)]
Seconds = Annotated[Finite, Field(ge=0)]


class Facts(Model):
    """Hold everything in a checkpoint except its tensors.

    `parts` has the numbers and flags that each `refgs.train.part.Part` remembers, by the part's name. `clock` has the seconds
    spent on each kind of work, such as shading, by its name.
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
