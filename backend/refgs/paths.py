"""Where things lie on this disk, and how they come to lie there."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from refgs.errors import InputError

PACKAGE = Path(__file__).resolve().parent
ROOT = PACKAGE.parents[1]
PRESETS = PACKAGE / "presets" if (PACKAGE / "presets").is_dir() else ROOT / "presets"  # in a wheel, in a clone


@contextmanager
def whole(path: str | os.PathLike) -> Iterator[Path]:
    """The name to write a file under, which becomes `path` once all of it is there; where that fails, nothing is left."""
    path = Path(path)
    temporary = path.with_name(path.name + ".tmp")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def clone_root() -> Path:
    """The repository's root, for what is not part of the package: the benchmark scenes and the Blender extension."""
    if not (ROOT / "blender_manifest.toml").exists():
        raise InputError("this needs the whole repository: clone it and install with `pip install -e .` from there")
    return ROOT
