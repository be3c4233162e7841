"""Write and read checkpoints: a safetensors file for the tensors, a TOML file for the rest.

The last two complete checkpoints are kept. The TOML file begins with a hash of both files' contents, so that damage is noticed.
"""

import errno
import os
import tomllib
from contextlib import suppress
from pathlib import Path
from typing import Any

import tomli_w
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from refgs.errors import InputError, TryAgain, reason
from refgs.events import Report
from refgs.paths import hash_file, read_text, whole

KEPT = 2
_HASH = "hash = "  # begins the TOML file's first line
DAMAGED = ".damaged"  # added to the names of a checkpoint's files that cannot be read


class NoCheckpoint(InputError):
    """Report that a folder has no complete checkpoint."""


def save(folder: Path, iteration: int, tensors: dict[str, Tensor], facts: dict[str, Any]) -> None:
    """Write the checkpoint of an iteration: its tensors to a safetensors file, and its other values, `facts`, to a TOML file.

    The checkpoint is complete once its TOML file is there. Older checkpoints than the last two are removed. Raises TryAgain when the disk
    is full; earlier checkpoints then stay complete.
    """
    folder.mkdir(exist_ok=True)
    data, note = _files(folder, iteration)
    text = tomli_w.dumps({"iteration": iteration, **facts})
    try:
        with whole(data) as temporary:
            save_file({name: value.detach().cpu().contiguous() for name, value in tensors.items()}, str(temporary))
            text = f'{_HASH}"{_hash(temporary, text)}"\n{text}'
        with whole(note) as temporary:
            temporary.write_text(text, encoding="utf-8")
    except Exception as error:
        # safetensors wraps the system's error and keeps only its text.
        if (
            getattr(error, "errno", None) == errno.ENOSPC
            or "No space left" in str(error)
            or "os error 28" in str(error)
        ):
            last = complete(folder)
            kept = f"the checkpoint of iteration {last[-1]} is whole" if last else "there is no earlier checkpoint"
            raise TryAgain(f"{folder}: the disk is full; {kept}: free some space, then train with --resume") from None
        raise
    for old in complete(folder)[:-KEPT]:
        with suppress(OSError):  # Windows removes no open file: the next save tries again
            for file in reversed(_files(folder, old)):
                file.unlink()
    for file in folder.glob("*.safetensors"):  # left by a process that was killed between writing the two files
        if not file.with_suffix(".toml").exists():
            with suppress(OSError):
                file.unlink()


def complete(folder: Path) -> list[int]:
    """List the iterations with a complete, but perhaps damaged, checkpoint, in ascending order."""
    return [iteration for iteration in _begun(folder) if all(file.exists() for file in _files(folder, iteration))]


def load(folder: Path, report: Report = lambda event, facts: None) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the tensors, and the other values as a dictionary, from the last complete checkpoint that is not damaged.

    Later checkpoints, which are damaged, are renamed, and each is reported with one line. Raises NoCheckpoint if none is left.
    """
    for iteration in reversed(_begun(folder)):
        try:
            return _read(folder, iteration)
        except (InputError, OSError, ValueError, KeyError, RecursionError, SafetensorError) as error:
            for file in _files(folder, iteration):
                set_aside(file)
            damaged = f"the checkpoint of iteration {iteration} is damaged and set aside as *{DAMAGED}"
            what = f"{folder}: {damaged}: {reason(error)}"
            report("warning", {"what": what})
    raise NoCheckpoint(f"{folder} holds no complete checkpoint: train without --resume into a new folder")


def set_aside(file: Path) -> None:
    """Add DAMAGED to an unreadable file's name; ignore a missing file or read-only folder."""
    with suppress(OSError):
        os.replace(file, file.with_name(file.name + DAMAGED))


def _begun(folder: Path) -> list[int]:
    """List the iterations with a checkpoint's TOML file, in ascending order."""
    return sorted(int(file.stem) for file in folder.glob("*.toml") if file.stem.isdecimal() and len(file.stem) == 8)


def _files(folder: Path, iteration: int) -> tuple[Path, Path]:
    """Return the paths of a checkpoint's safetensors file and TOML file, in writing order."""
    return folder / f"{iteration:08d}.safetensors", folder / f"{iteration:08d}.toml"


def _read(folder: Path, iteration: int) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read a checkpoint's tensors and TOML values; if damaged, raise an error that `load` catches."""
    data, note = _files(folder, iteration)
    whole_text = read_text(note, "").replace("\r\n", "\n")  # with the line ends that were hashed
    head, _, text = whole_text.partition("\n")
    if not head.startswith(_HASH):  # an earlier release wrote none
        text = whole_text
    elif head != f'{_HASH}"{_hash(data, text)}"':
        raise ValueError("its files are not what was written")
    facts = tomllib.loads(text)
    if facts["iteration"] != iteration:
        raise ValueError(f"it says that it is of iteration {facts['iteration']}")
    return load_file(str(data)), facts


def _hash(data: Path, text: str) -> str:
    """Hash a checkpoint's tensor file and the TOML `text` after the line with the hash."""
    found = hash_file(data)
    found.update(text.encode())
    return found.hexdigest()
