"""Find the program's own files. Write files so that a failed write leaves no half-written file."""

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
    """Write a file completely or not at all.

    Yields a temporary path to write to. It is renamed to `path` at the end of the `with` block, or deleted if the block raises an error.
    """
    path = Path(path)
    temporary = path.with_name(path.name + ".tmp")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(file: Path, text: str) -> None:
    """Write a text file completely or not at all."""
    with whole(file) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextmanager
def disk_errors_named(folders: list[Path], again: str) -> Iterator[None]:
    """Turn disk errors in a `with` block into InputErrors that name the folder: the disk is full, read-only or gone.

    `again` is added to the message: it tells the user how to continue when the disk works again.
    """
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
    """Raise InputError if the folder of a capture does not exist."""
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder. Name the folder that holds the capture.")


def clone_root() -> Path:
    """Return the root of the repository. Raise InputError if the program was installed without it.

    The benchmark scenes and the Blender extension are in the repository, but not in the installed package.
    """
    if not (ROOT / "blender_manifest.toml").exists():
        raise InputError("this needs the whole repository: clone it and install with `pip install -e .` from there")
    return ROOT
