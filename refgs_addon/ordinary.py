"""Open files that others wrote, but only regular files. A pipe or a device may have no end, and Blender would wait for it."""

import errno
import json
import os
import re
import stat
from pathlib import Path
from typing import BinaryIO

from .errors import InputError

LARGEST = 64 << 20  # bytes of a text file


def check_file(path: Path) -> None:
    """Raise OSError unless a path leads to a regular file that is not empty."""
    facts = os.stat(path)
    if not stat.S_ISREG(facts.st_mode):
        raise OSError(errno.EINVAL, "this is not a file", str(path))
    if not facts.st_size:
        raise OSError(errno.EINVAL, "the file is empty", str(path))


def open_file(path: Path) -> BinaryIO:
    """Open a regular file to read its bytes. Raises OSError also if it is empty."""
    check_file(path)
    return open(path, "rb")


def read_text(path: Path) -> str:
    """Read a UTF-8 text file.

    Raises OSError if it cannot be read, is not a regular file, or is empty. Raises ValueError if it is not UTF-8, or larger than 64 MiB.
    """
    with open_file(path) as file:
        data = file.read(LARGEST + 1)
    if len(data) > LARGEST:
        raise ValueError(f"{path} is larger than such a file can be")
    return data.decode("utf-8")


def check_gltf(path: Path) -> None:
    """Raise InputError if a glTF file, binary or text, refers to files outside its folder. Blender's importer would open such files.

    A URI in the file may contain data, or be a relative path without "..". Also raises InputError if the file is broken, or if a file that
    it refers to is missing or empty.
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
    decoded = re.sub(
        rb"%([0-9a-fA-F]{2})", lambda code: bytes.fromhex(code[1].decode()), uri.encode("utf-8", "replace")
    )
    name = decoded.decode("utf-8", "replace").replace("\\", "/")
    parts = name.split("/")
    if ":" in name or not parts[0] or ".." in parts:
        raise InputError(f"{path} names a file outside of its folder, {uri[:100]}: import a mesh that you trust")
    check_file(path.parent / name)
