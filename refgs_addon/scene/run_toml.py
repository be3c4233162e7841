"""Read from run.toml how a run was trained. A file that is missing or cannot be read counts as an empty file."""

import math
import tomllib
from pathlib import Path

from ..ordinary import read_text

MANIFEST = Path(__file__).resolve().parents[2] / "blender_manifest.toml"


def capture_of(run: Path) -> Path | None:
    """Return the folder of the capture that a run was trained on, or None if it is unknown."""
    capture = _table(run, "run").get("capture")
    return Path(capture) if isinstance(capture, str) and capture else None


def up_was_chosen(run: Path) -> bool:
    """Check whether the artist's up direction rotated a run relative to its capture's cameras."""
    try:
        x, y, z = map(float, _table(run, "settings")["region"]["up"])
        return math.hypot(x, y) > 1e-3 * z and any((x, y, z))
    except (KeyError, TypeError, ValueError, OverflowError):
        return False


def newer_release(run: Path) -> str:
    """Return the RefGS release that trained a run if newer than the add-on, else ""."""
    made_by = _table(run, "run").get("refgs")
    own = tomllib.loads(MANIFEST.read_text(encoding="utf-8"))["version"]
    try:
        return made_by if _release(made_by) > _release(own) else ""
    except (AttributeError, ValueError):
        return ""


def _release(version: str) -> tuple[int, ...]:
    return tuple(int(number) for number in version.split(".")[:2])  # the third number only fixes bugs


def _table(run: Path, name: str) -> dict:
    try:
        table = tomllib.loads(read_text(run / "run.toml")).get(name)
    except (OSError, ValueError, RecursionError):
        return {}
    return table if isinstance(table, dict) else {}
