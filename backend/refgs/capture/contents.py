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
    """Return the BLAKE2b hash of each file's contents, by its path relative to `folder`. Raises InputError if a file cannot be read."""
    named = {Path(os.path.relpath(file, folder)).as_posix(): file for file in files}
    with ThreadPoolExecutor() as threads:  # hashlib works outside of Python's lock
        return dict(zip(named, threads.map(_hash, named.values()), strict=True))


def write_hashes(run: Path, hashes: dict[str, str]) -> None:
    """Write the hashes of a capture's files into the folder of a run that is trained on it."""
    write_text(run / FILE, json.dumps(hashes, indent=1))


def changed_files(run: Path, hashes: dict[str, str]) -> list[str]:
    """Return the paths of the files whose hashes differ from those in a run's folder.

    Return [] if the folder has no hashes, as in runs of earlier releases.
    """
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
