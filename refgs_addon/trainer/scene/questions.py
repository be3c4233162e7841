"""Read what a run's photos leave open: pieces of the surface that may be metal or paint. One answer is a hint for a training."""

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import bpy

from ...errors import InputError
from ...json_file import read_json
from ...scene.run_parts import FOLDER

if TYPE_CHECKING:
    import numpy as np

FILE = "questions.json"
KINDS = "metal", "paint"


class Question(NamedTuple):
    """Hold a question about a piece of a run's surface.

    `part` is its fraction of the surface. `now` is what the training took it for, "metal" or "paint". `picture` is a file with a photo, and
    below it the piece as metal and as paint. `points` (P, 3) are its splats' positions, in the splats' coordinates.
    """

    part: float
    now: str
    picture: Path
    points: "np.ndarray"


def questions(collection: bpy.types.Collection) -> list[Question]:
    """Return the questions of an imported run, the largest piece first; [] if it has none, or if its folder has moved."""
    file = Path(bpy.path.abspath(collection.get(FOLDER, ""))) / FILE
    try:
        return _read(file, file.stat().st_mtime_ns)
    except (OSError, InputError, KeyError, TypeError, ValueError):  # none, half copied, or of a newer release
        return []


@lru_cache(maxsize=8)
def _read(file: Path, changed: int) -> list[Question]:
    """Read the file. It is read again only if it has `changed` since, because a panel is drawn often."""
    import numpy as np

    return [
        Question(float(row["part"]), str(row["now"]), file.parent / row["picture"], np.array(row["points"], float))
        for row in read_json(file)["questions"]
    ]
