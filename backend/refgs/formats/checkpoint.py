"""Describe the TOML file of a checkpoint: all that the next iteration depends on, except the tensors."""

from typing import Annotated

from pydantic import ConfigDict, Field

from refgs.formats.validate import Finite, Model

Count = Annotated[int, Field(ge=0, le=10**9, strict=True)]
Seconds = Annotated[Finite, Field(ge=0)]


class Decision(Model):
    """Hold a recorded decision about an optional part of the training. Its figures differ from part to part."""

    model_config = ConfigDict(extra="allow")

    needed: bool
    why: str
    seconds: Finite = 0.0
    megabytes: Finite = 0.0
    decibels: Finite = 0.0
    side: Annotated[Finite, Field(ge=0)] = 0.0
    total: Annotated[Finite, Field(ge=0)] = 0.0


class Facts(Model):
    """Hold what a checkpoint knows besides its tensors. Values that have a default were not written by earlier releases."""

    iteration: Count
    total: Count
    seconds: Seconds
    initial: bool | None = None
    decided: dict[str, str] = Field(default_factory=dict)
    parts: dict[str, Finite] = Field(default_factory=dict)
    spent: Seconds | None = None
    processor_seconds: Seconds = 0.0
    needs: dict[str, Decision] = Field(default_factory=dict)
    metals_set: bool = True
    poses_judged: bool = True
    reduced: Annotated[Count, Field(ge=1, le=64)] = 1
