"""Check run folders, read run.toml and update metrics.json. This module does not import torch."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

from refgs import __version__
from refgs.asked import Asked
from refgs.errors import InputError
from refgs.formats.metrics import read_metrics
from refgs.formats.run_toml import Made, RunFile, Trained
from refgs.formats.validate import read_tables, validated
from refgs.lock import LOCK, PROGRESS, STOP
from refgs.paths import check_unicode, command_line, is_leftover, write_text
from refgs.settings import Settings, recorded_settings

PHOTOS = "photos"  # a folder of reduced photos, while they are trained on
CHECKPOINTS = "checkpoints"
LOG = "log.txt"  # the lines of all events, and tracebacks
SPLATS = "splats.ply"  # written last: a run that has it has ended
# What a training leaves that is killed before its first checkpoint: what it writes before run.toml, and after it.
_BEFORE = (CHECKPOINTS, "capture.json", "cameras.json", "hints.json")
_AFTER = ("run.toml", "needs.json", "needs", "history.jsonl", "preview")
_KEPT = (PHOTOS, LOG, LOCK, PROGRESS, STOP)  # does no harm to a new run


def check_free(folder: Path) -> None:
    """Raise InputError if a folder cannot take a new run: it is a file, holds a run or other files, or its name is not Unicode.

    Files of a training that was killed before its first checkpoint do not count, because that training has learned nothing.
    """
    check_unicode(folder)
    if folder.exists() and not (folder.is_dir() and _nothing_learned(folder)):
        what = "holds another run" if (folder / "run.toml").exists() else "is not empty"
        raise InputError(f"{folder} {what}: choose another folder with --out, or resume that run with --resume")


def clear(folder: Path) -> None:
    """Remove a training killed before its first checkpoint. Raises InputError for anything else."""
    check_free(folder)
    for name in reversed((*_BEFORE, *_AFTER)):  # killed here, it leaves what is free again
        if (folder / name).is_dir():
            shutil.rmtree(folder / name)
        else:
            (folder / name).unlink(missing_ok=True)


def _nothing_learned(folder: Path) -> bool:
    """Return True if a folder holds only a training killed before its first checkpoint."""
    own, checkpoints = {*_KEPT}, folder / CHECKPOINTS
    if checkpoints.is_dir():
        own |= {*_BEFORE}
        if (folder / "run.toml").exists():
            own |= {*_AFTER}
            if any(checkpoints.glob("*.toml*")):  # the name of a damaged one ends in more
                return False
    return all(file.name in own or is_leftover(file) for file in folder.iterdir())


def check_finished(folder: Path) -> tuple[Trained, Settings]:
    """Return run.toml's facts and settings. Raises InputError if the training has not ended."""
    facts, settings = read_run_facts(folder)
    if not (folder / SPLATS).exists():
        again = f"refgs train … {command_line('--out', folder, '--resume')}"
        raise InputError(f"{folder}: the training has not ended: resume it with `{again}`")
    return facts, settings


def read_run_facts(folder: Path) -> tuple[Trained, Settings]:
    """Return run.toml's table [run] and settings. Raises InputError if it cannot be used."""
    found = _read_run(folder)
    return found.run, recorded_settings(found.settings, str(folder / "run.toml"))


def _read_run(folder: Path) -> RunFile:
    file, again = folder / "run.toml", "Train again."
    if not os.path.lexists(file):
        raise InputError(f"{folder} is not a run folder: there is no run.toml in it")
    tables = read_tables(file, again)
    made_by = validated(tables, Made, str(file), again).run.refgs
    if _release(made_by) > _release(__version__):
        raise InputError(f"{folder} was made by RefGS {made_by}, which is newer than this, {__version__}: update RefGS")
    return validated(tables, RunFile, str(file), again)


def check_asked(asked: Asked) -> None:
    """Raise InputError if the run in the folder `asked.out` was trained with other settings than `asked` has.

    If the settings of `asked` are chosen to fit into a time, only the time is compared. A run with hints is not checked: it has
    the settings of the run that it continues.
    """
    known = _read_run(asked.out)
    if asked.hints is not None:
        return  # it has the settings of the run that it continues
    another = "choose another folder with --out, or ask for the same"
    if asked.planned:
        if known.run.preset != asked.preset_name:
            raise InputError(f"{asked.out} was trained by {known.run.preset}, not for {asked.preset_name}: {another}")
        return  # its settings were chosen
    tables = recorded_settings(known.settings, str(asked.out / "run.toml")).model_dump(mode="json")
    for key, row in known.changed.items():
        section, name = key.split(".")
        tables[section][name] = row.asked
    wanted = asked.settings().model_dump(mode="json")
    for section, table in wanted.items():
        for name, value in table.items():
            if value != (was := tables[section][name]):
                what = f"{section}.{name} = {was}, and not {value}"
                raise InputError(f"{asked.out} was trained with {what}: {another}")


def _release(version: str) -> tuple[int, ...]:
    return tuple(int(number) for number in version.split(".")[:2])  # a patch release changes no file format


def update_metrics(folder: Path, facts: dict[str, Any]) -> None:
    """Merge results into a run's metrics.json, where new values replace old ones."""

    def merged(known: dict, new: dict) -> dict:
        both = {key: merged(known[key], new[key]) for key in new if isinstance(known.get(key), dict)}
        return known | new | both

    write_text(folder / "metrics.json", json.dumps(merged(run_metrics(folder), facts), indent=1))


def run_metrics(folder: Path) -> dict[str, Any]:
    """Read a run's metrics.json. Returns {} if there is none."""
    file = folder / "metrics.json"
    return read_metrics(file)[0] if file.exists() else {}
