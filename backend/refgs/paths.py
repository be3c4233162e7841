"""Find the program's own files; write files whole or not at all."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from refgs.errors import InputError

PACKAGE = Path(__file__).resolve().parent
ROOT = PACKAGE.parents[1]
PRESETS = PACKAGE / "presets" if (PACKAGE / "presets").is_dir() else ROOT / "presets"  # in a wheel, in a clone
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.EACCES)


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


@contextmanager
def disk_errors_named(folders: list[Path], again: str) -> Iterator[None]:
    """In a `with`: raise InputError if the disk of a folder is full, read-only or gone. The message includes `again`: what to do then."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        if gone := next((folder for folder in folders if not folder.is_dir()), None):
            raise InputError(f"{gone} is no longer there: put its disk back, then {again}") from error
        if isinstance(error, OSError) and error.errno in DISK_ERRORS:
            why = f"{error.filename or folders[0]} cannot be written ({error.strerror})"
            raise InputError(f"{why}: mend that, then {again}; files written before are complete") from error
        raise


def check_folder(folder: Path) -> None:
    """Raise InputError unless the folder of a capture exists."""
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder. Name the folder that holds the capture.")


def clone_root() -> Path:
    """Return the repository's root, which holds the benchmark scenes and the Blender extension; neither is in the package."""
    if not (ROOT / "blender_manifest.toml").exists():
        raise InputError("this needs the whole repository: clone it and install with `pip install -e .` from there")
    return ROOT
