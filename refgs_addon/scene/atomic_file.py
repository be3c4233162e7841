"""Files that are written whole or not at all."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from ..errors import InputError


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A file beside, to be written, that then becomes the one that is meant. Raises InputError where that cannot be."""
    # The ending stays last: Blender adds it where it does not see it.
    temporary = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except (RuntimeError, OSError) as error:  # Blender's own writing raises the first
        reason = getattr(error, "strerror", None) or "is its folder there, with room on the disk?"
        raise InputError(f"cannot write {path}: {reason}") from None
    finally:
        with contextlib.suppress(OSError):  # as where its folder is no folder
            temporary.unlink(missing_ok=True)
