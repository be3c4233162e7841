"""Check a run folder, read its run.toml and add to its metrics.json, without torch."""

import json
import tomllib
from pathlib import Path
from typing import Any

from refgs import __version__
from refgs.errors import InputError
from refgs.paths import write_text
from refgs.settings import Settings, recorded_settings


def check_free(folder: Path) -> None:
    """Raise InputError unless a new run can go into the folder."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        what = "holds another run" if (folder / "run.toml").exists() else "is not empty"
        raise InputError(f"{folder} {what}: choose another folder with --out, or resume that run with --resume")


def check_finished(folder: Path) -> tuple[dict, Settings]:
    """Raise InputError unless the folder holds a run whose training has ended. Returns the result of `read_run_facts`."""
    facts, settings = read_run_facts(folder)
    if not (folder / "splats.ply").exists():
        raise InputError(
            f"{folder}: the training has not ended: resume it with `refgs train … --out {folder} --resume`"
        )
    return facts, settings


def read_run_facts(folder: Path) -> tuple[dict, Settings]:
    """Read the [run] table and the settings of run.toml. Raise InputError without a run.toml, and for one by a newer release."""
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
    """Merge figures into a run's metrics.json. New figures replace those of the same name, at any depth."""

    def merged(known: dict, new: dict) -> dict:
        both = {key: merged(known[key], new[key]) for key in new if isinstance(known.get(key), dict)}
        return known | new | both

    file = folder / "metrics.json"
    known = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    write_text(file, json.dumps(merged(known, facts), indent=1))
