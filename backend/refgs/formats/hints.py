"""Read and write hints: the parts of a reconstructed surface that a user says are metal or paint (docs/run-folder.md)."""

import json
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, get_args

import numpy as np
from pydantic import Field

from refgs.formats.validate import Model, Vector, read_json
from refgs.paths import write_text

FILE = "hints.json"  # in the folder of a run that was trained with hints
Kind = Literal["metal", "paint"]
KINDS = get_args(Kind)


class Hint(NamedTuple):
    """Hold a user's hint: the material `kind` of a part of the surface, "metal" or "paint".

    `points` (P, 3) are positions on the part, in the run's coordinates. Each point marks the splat that is nearest to it.
    """

    kind: Kind
    points: np.ndarray


class _Part(Model):
    kind: Kind
    points: Annotated[list[Vector], Field(min_length=1)]


class _Hints(Model):
    hints: Annotated[list[_Part], Field(min_length=1)]


def read_hints(file: Path) -> list[Hint]:
    """Read one hint or more from a JSON file, or raise InputError."""
    again = 'Hints are JSON as {"hints": [{"kind": "metal", "points": [[0.1, 0.2, 0.3]]}]}: say of one part at least what it is.'
    found = read_json(file, _Hints, again)
    return [Hint(part.kind, np.array(part.points, np.float64)) for part in found.hints]


def write_hints(file: Path, run: Path, hints: list[Hint]) -> None:
    """Write hints, which mark splats of the folder `run`, to a JSON file."""
    listed = [{"kind": hint.kind, "points": hint.points.tolist()} for hint in hints]
    write_text(file, json.dumps({"run": str(run.resolve()), "hints": listed}))
