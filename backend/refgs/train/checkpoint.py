"""Write and read checkpoints: a safetensors file for the tensors, a TOML file for the rest.

The last two complete checkpoints are kept.
"""

import errno
import os
import tomllib
from pathlib import Path
from typing import Any

import tomli_w
from safetensors.torch import load_file, save_file
from torch import Tensor

from refgs.errors import InputError

KEPT = 2


def save(folder: Path, iteration: int, tensors: dict[str, Tensor], facts: dict[str, Any]) -> None:
    """Write the tensors of an iteration to a safetensors file, and its other values, `facts`, to a TOML file.

    The checkpoint is complete once its TOML file is there. Older checkpoints than the last two are removed. Raises InputError when the disk
    is full; earlier checkpoints then stay complete.
    """
    folder.mkdir(exist_ok=True)
    data, note = folder / f"{iteration:08d}.safetensors", folder / f"{iteration:08d}.toml"
    temporary = [file.with_name(file.name + ".tmp") for file in (data, note)]
    try:
        save_file({name: value.detach().cpu().contiguous() for name, value in tensors.items()}, str(temporary[0]))
        temporary[1].write_text(tomli_w.dumps({"iteration": iteration, **facts}), encoding="utf-8")
        for file in temporary:
            with open(file, "rb") as handle:
                os.fsync(handle.fileno())
        os.replace(temporary[0], data)
        os.replace(temporary[1], note)
    except Exception as error:
        for file in temporary:
            file.unlink(missing_ok=True)
        # safetensors wraps the system's error and keeps only its text.
        if (
            getattr(error, "errno", None) == errno.ENOSPC
            or "No space left" in str(error)
            or "os error 28" in str(error)
        ):
            last = complete(folder)
            kept = f"the checkpoint of iteration {last[-1]} is whole" if last else "there is no earlier checkpoint"
            raise InputError(f"{folder}: the disk is full; {kept}: free some space, then train with --resume") from None
        raise
    for old in complete(folder)[:-KEPT]:
        (folder / f"{old:08d}.toml").unlink()
        (folder / f"{old:08d}.safetensors").unlink()


def complete(folder: Path) -> list[int]:
    """List the iterations that have a complete checkpoint, in ascending order."""
    return sorted(
        int(file.stem)
        for file in folder.glob("*.toml")
        if file.stem.isdigit() and file.with_suffix(".safetensors").exists()
    )


def load(folder: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the tensors, and the other values as a dictionary, from the last complete checkpoint. Raises InputError if there is none."""
    iterations = complete(folder)
    if not iterations:
        raise InputError(f"{folder} holds no complete checkpoint: train without --resume into a new folder")
    stem = folder / f"{iterations[-1]:08d}"
    facts = tomllib.loads(stem.with_suffix(".toml").read_text(encoding="utf-8"))
    return load_file(str(stem.with_suffix(".safetensors"))), facts
