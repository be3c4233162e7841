"""Paths of the program's own files, and writing files whole or not at all."""

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
    """Yield a temporary name to write to; rename it to `path` at the end, or delete it if that fails."""
    path = Path(path)
    temporary = path.with_name(path.name + ".tmp")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(file: Path, text: str) -> None:
    """Write a text file whole or not at all."""
    with whole(file) as temporary:
        temporary.write_text(text, encoding="utf-8")


def clone_root() -> Path:
    """Return the repository's root, which holds the benchmark scenes and the Blender extension; neither is in the package."""
    if not (ROOT / "blender_manifest.toml").exists():
        raise InputError("this needs the whole repository: clone it and install with `pip install -e .` from there")
    return ROOT
