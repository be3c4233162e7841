"""Hash the contents of a capture's files. A run keeps the hashes, so that later changes of these files are noticed."""

import hashlib
import json
import os
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from refgs.errors import InputError
from refgs.paths import hash_file, read_bytes, write_text

FILE = "capture.json"  # in the run folder
_HASHES = TypeAdapter(dict[str, str])


def hash_files(folder: Path, files: list[Path]) -> dict[str, str]:
    """Return the files' BLAKE2b hashes by paths relative to `folder`. Raises InputError."""
    named = {Path(os.path.relpath(file, folder)).as_posix(): file for file in files}
    with ThreadPoolExecutor() as threads:  # hashlib works outside of Python's lock
        return dict(zip(named, threads.map(_hash, named.values()), strict=True))


def write_hashes(run: Path, hashes: dict[str, str]) -> None:
    """Write the hashes of a capture's files into a run's folder."""
    write_text(run / FILE, json.dumps(hashes, indent=1))


def changed_files(run: Path, hashes: dict[str, str]) -> list[str]:
    """Return the paths whose hashes differ from the run's, [] if it has none."""
    try:
        known = _HASHES.validate_json(read_bytes(run / FILE))
    except (OSError, ValidationError):
        return []
    return [name for name, hashed in hashes.items() if known.get(name, hashed) != hashed]


def _hash(file: Path) -> str:
    try:
        return hash_file(file, partial(hashlib.blake2b, digest_size=16)).hexdigest()
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror}") from None
