"""Check run folders, read run.toml and update metrics.json. This module does not import torch."""

import json
import tomllib
from pathlib import Path
from typing import Any

from refgs import __version__
from refgs.errors import InputError
from refgs.paths import write_text
from refgs.settings import Settings, recorded_settings

PHOTOS = "photos"  # a folder of reduced photos, while they are trained on


def check_free(folder: Path) -> None:
    """Raise InputError if a new run cannot be created in the folder, because it is not empty or is a file.

    Reduced photos do not count: a training that was killed while it read them leaves these, and the next one uses them.
    """
    if folder.exists() and (not folder.is_dir() or any(file.name != PHOTOS for file in folder.iterdir())):
        what = "holds another run" if (folder / "run.toml").exists() else "is not empty"
        raise InputError(f"{folder} {what}: choose another folder with --out, or resume that run with --resume")


def check_finished(folder: Path) -> tuple[dict, Settings]:
    """Raise InputError if the folder is no run folder, or if its training has not ended.

    Otherwise return what `read_run_facts` returns: the table [run] and the settings.
    """
    facts, settings = read_run_facts(folder)
    if not (folder / "splats.ply").exists():
        raise InputError(
            f"{folder}: the training has not ended: resume it with `refgs train … --out {folder} --resume`"
        )
    return facts, settings


def read_run_facts(folder: Path) -> tuple[dict, Settings]:
    """Read run.toml. Return its table [run] as a dict, and the settings of the training.

    Raises InputError if there is no run.toml, or if a newer release has written it.
    """
    file = folder / "run.toml"
    try:
        facts = tomllib.loads(file.read_text(encoding="utf-8"))
        made_by = facts["run"]["refgs"]
        if _release(made_by) > _release(__version__):
            raise InputError(
                f"{folder} was made by RefGS {made_by}, which is newer than this, {__version__}: update RefGS"
            )
        return facts["run"], recorded_settings(facts["settings"], str(file))
    except FileNotFoundError:
        raise InputError(f"{folder} is not a run folder: there is no run.toml in it") from None
    except (OSError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise InputError(f"{file} is broken ({error}): train again") from None


def _release(version: str) -> tuple[int, ...]:
    return tuple(int(number) for number in version.split(".")[:2])  # a patch release changes no file format


def update_metrics(folder: Path, facts: dict[str, Any]) -> None:
    """Merge results into a run's metrics.json. A new value replaces the old value of the same name, also in nested dicts."""

    def merged(known: dict, new: dict) -> dict:
        both = {key: merged(known[key], new[key]) for key in new if isinstance(known.get(key), dict)}
        return known | new | both

    file = folder / "metrics.json"
    known = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    write_text(file, json.dumps(merged(known, facts), indent=1))
