"""Read and write hints: which parts of a run's surface are metal or paint, as a user says (docs/run-folder.md)."""

import json
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np

from refgs.errors import InputError
from refgs.paths import write_text

FILE = "hints.json"  # in the folder of a run that was trained with hints
Kind = Literal["metal", "paint"]
KINDS = get_args(Kind)


class Hint(NamedTuple):
    """Say of what `kind` a part of the surface is. `points` (P, 3) are the positions of its splats, in the run's frame."""

    kind: Kind
    points: np.ndarray


def read_hints(file: Path) -> list[Hint]:
    """Read the hints in a JSON file. Raises InputError if the file cannot be read, is no file of hints, or has no hint."""
    try:
        listed = json.loads(file.read_text(encoding="utf-8"))["hints"]
        hints = [Hint(hint["kind"], np.array(hint["points"], np.float64).reshape(-1, 3)) for hint in listed]
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError):
        raise InputError(f'{file} has no hints: it must be JSON as {{"hints": [{{"kind": "metal", …}}]}}') from None
    for hint in hints:
        if hint.kind not in KINDS:
            raise InputError(f"{file}: a hint is of the kind {hint.kind!r}: take {' or '.join(KINDS)}")
        if len(hint.points) == 0 or not np.isfinite(hint.points).all():
            raise InputError(f"{file}: the points of a hint must be positions of splats, at least one: choose a part")
    if not hints:
        raise InputError(f"{file} has no hints: say of one part at least what it is")
    return hints


def write_hints(file: Path, run: Path, hints: list[Hint]) -> None:
    """Write hints to a JSON file, with the path of the `run` whose splats they are about."""
    listed = [{"kind": hint.kind, "points": hint.points.tolist()} for hint in hints]
    write_text(file, json.dumps({"run": str(run.resolve()), "hints": listed}))
