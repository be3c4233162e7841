"""Open files that others wrote: only ordinary ones. A pipe or a device may have no end, and Blender would wait for it."""

import errno
import json
import os
import stat
from pathlib import Path
from typing import BinaryIO
from urllib.parse import unquote, urlsplit

from .errors import InputError

LARGEST = 64 << 20  # bytes of a text file


def check_file(path: Path) -> None:
    """Raise OSError if a path leads to no ordinary file, or to an empty one. Linux's /proc has files that count as empty and never end."""
    facts = os.stat(path)
    if not stat.S_ISREG(facts.st_mode):
        raise OSError(errno.EINVAL, "this is not a file", str(path))
    if not facts.st_size:
        raise OSError(errno.EINVAL, "the file is empty", str(path))


def open_file(path: Path) -> BinaryIO:
    """Open an ordinary file to read its bytes. Raises OSError if it cannot be read, is no such file, or is empty."""
    check_file(path)
    return open(path, "rb")


def read_text(path: Path) -> str:
    """Read a file in UTF-8. Raises OSError if it cannot be read, and ValueError if it is no text or has more than LARGEST bytes."""
    with open_file(path) as file:
        data = file.read(LARGEST + 1)
    if len(data) > LARGEST:
        raise ValueError(f"{path} is larger than such a file can be")
    return data.decode("utf-8")


def check_gltf(path: Path) -> None:
    """Raise InputError if a glTF file names files that are not beside it. Blender's importer would open them, wherever they are.

    The file is binary or text. A URI may hold data, or be a relative path without "..".
    """
    try:
        with open_file(path) as file:
            # "glTF", the version and the length; the length of the JSON and "JSON" (glTF 2.0, 4.4).
            head = file.read(20)
            length = min(int.from_bytes(head[12:16], "little"), LARGEST)
            text = file.read(length) if head[:4] == b"glTF" else head + file.read(LARGEST)
        found = [json.loads(text)]
        while found:
            value = found.pop()
            found += value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
            if isinstance(value, dict) and isinstance(uri := value.get("uri"), str) and not uri.startswith("data:"):
                _check_beside(path, uri)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except (ValueError, RecursionError):
        raise InputError(f"{path} is no whole glTF file: export the mesh again") from None


def _check_beside(path: Path, uri: str) -> None:
    name = unquote(uri).replace("\\", "/")
    parts = name.split("/")
    if urlsplit(uri).scheme or ":" in name or not parts[0] or ".." in parts:
        raise InputError(f"{path} names a file outside of its folder, {uri[:100]}: import a mesh that you trust")
    check_file(path.parent / name)
