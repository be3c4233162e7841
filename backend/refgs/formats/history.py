"""Read history.jsonl: the errors measured during a training, one JSON object a line (docs/run-folder.md)."""

from pathlib import Path
from typing import Annotated

from pydantic import Field, TypeAdapter, ValidationError
from typing_extensions import TypedDict

from refgs.paths import read_bytes

FILE = "history.jsonl"  # in the run folder

_Number = Annotated[int, Field(ge=-(2**53), le=2**53)] | float | None


class _Line(TypedDict, total=False, extra_items=_Number):
    iteration: _Number
    parts: dict[str, _Number]


_LINE = TypeAdapter(_Line)


def read(file: Path) -> tuple[list[dict], int]:
    """Read the lines of a history.jsonl file. Return a dictionary for each valid line, and the number of damaged lines.

    The dictionaries have numbers or None as values. Only the value of the key `parts` is a dictionary, of numbers or None. A damaged line
    can come from a training that was killed while it wrote. Raises OSError if the file cannot be read.
    """
    found, damaged = [], 0
    for line in read_bytes(file).split(b"\n"):
        if line.strip():
            try:
                found.append(_LINE.validate_json(line, strict=True))
            except ValidationError:
                damaged += 1
    return found, damaged


def damage(count: int) -> str:
    """Return a sentence telling the user that `count` lines of history.jsonl are left out."""
    return f"{FILE} has damaged lines, which are left out: {count}"
