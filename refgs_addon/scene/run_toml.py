"""What a run folder's run.toml says of the run: nothing, where there is none or it cannot be read."""

import math
import tomllib
from pathlib import Path

MANIFEST = Path(__file__).resolve().parents[2] / "blender_manifest.toml"


def capture_of(run: Path) -> Path | None:
    """The folder of the capture that a run is of."""
    capture = _table(run, "run").get("capture")
    return Path(capture) if isinstance(capture, str) else None


def tilted(run: Path) -> bool:
    """Whether a run stands otherwise than its capture's cameras, another direction than theirs having been chosen as up."""
    try:
        x, y, z = _table(run, "settings")["region"]["up"]
        return math.hypot(x, y) > 1e-3 * z and any((x, y, z))
    except (KeyError, TypeError, ValueError):
        return False


def newer(run: Path) -> str:
    """The release that made a run, where this add-on is of an older one, which may not know all that is in it; else ""."""
    made_by = _table(run, "run").get("refgs")
    own = tomllib.loads(MANIFEST.read_text(encoding="utf-8"))["version"]
    try:
        return made_by if _release(made_by) > _release(own) else ""
    except (AttributeError, ValueError):
        return ""


def _release(version: str) -> tuple[int, ...]:
    return tuple(int(number) for number in version.split(".")[:2])  # the third only mends


def _table(run: Path, name: str) -> dict:
    try:
        table = tomllib.loads((run / "run.toml").read_text(encoding="utf-8")).get(name)
    except (OSError, ValueError):
        return {}
    return table if isinstance(table, dict) else {}
