"""Read history.jsonl: the errors measured during a training, one JSON object a line (docs/run-folder.md)."""

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from refgs.paths import read_bytes

FILE = "history.jsonl"  # in the run folder

_Number = Annotated[int, Field(ge=-(2**53), le=2**53)] | float | None


class _Line(BaseModel):
    model_config = ConfigDict(extra="allow", strict=True)
    __pydantic_extra__: dict[str, _Number]

    iteration: _Number = None
    parts: dict[str, _Number] = {}


def read(file: Path) -> tuple[list[dict], int]:
    """Read the lines of a history.jsonl file as dictionaries. Return them, and the number of damaged lines, which are left out.

    Values are numbers or None; `parts` is a dictionary of such. A training that is killed can leave a truncated line. Raises OSError if the
    file cannot be read.
    """
    found, damaged = [], 0
    for line in read_bytes(file).split(b"\n"):
        if line.strip():
            try:
                found.append(_Line.model_validate_json(line).model_dump(exclude_unset=True))
            except ValidationError:
                damaged += 1
    return found, damaged


def damage(count: int) -> str:
    """Return a sentence for the user about `count` damaged lines."""
    return f"{FILE} has damaged lines, which are left out: {count}"
