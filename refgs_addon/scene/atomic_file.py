"""Write a file completely or not at all."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from ..errors import InputError


@contextlib.contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary file that becomes `path` after the `with` block. Raises InputError."""
    # Keep the extension last: Blender appends a missing one.
    temporary = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except (RuntimeError, OSError) as error:
        raise unwritable(path, error) from None
    finally:
        with contextlib.suppress(OSError):  # its parent may be a file
            temporary.unlink(missing_ok=True)


def unwritable(path: Path, error: RuntimeError | OSError) -> InputError:
    """Return an InputError that says why a file cannot be written."""
    reason = getattr(error, "strerror", None) or "does its folder exist, and has the disk free space?"
    return InputError(f"cannot write {path}: {reason}")
