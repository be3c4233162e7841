"""Read JSON files that other programs wrote."""

import json
from pathlib import Path

from .errors import InputError
from .ordinary import read_text


def read_json(path: Path) -> dict | list:
    """Read a dictionary or list from a JSON file. Raises InputError where there is none."""
    try:
        found = json.loads(read_text(path))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except (ValueError, RecursionError):  # the latter if it is nested too deeply
        found = None
    if not isinstance(found, dict | list):
        raise InputError(f"{path} is no whole JSON file: copy or write it again")
    return found
