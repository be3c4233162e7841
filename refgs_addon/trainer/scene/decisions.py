"""Read the decisions of a training. A decision says whether an optional part, such as specular reflection, was kept or left out.

Each decision has pictures rendered with and without the part. The artist can confirm a decision, or train again with the opposite one
(`training.train_other_way`).
"""

from dataclasses import dataclass
from pathlib import Path

import bpy

from ...errors import InputError
from ...json_file import read_json

ON_OFF = ("on", "off")  # words of the trainer's settings [needs]


@dataclass(frozen=True)
class Decision:
    """Hold one decision of a training: whether an optional part, such as specular reflection, was kept. It is an entry of needs.json.

    `need` is the part's name in the trainer's settings, `what` its name in words. `needed` says whether the part was kept, and `why` gives
    the reason. `pictures` maps "on" (rendered with the part), "off" (without it) and "photo" to files. All three show the view `view`.
    `psnr` maps "on" and "off" to the PSNR of these two pictures against the photo, in dB.
    """

    need: str
    what: str
    why: str
    needed: bool
    view: str
    pictures: dict[str, Path]
    psnr: dict[str, float]

    @property
    def answer(self) -> str:
        return "on" if self.needed else "off"

    @property
    def other(self) -> str:
        return "off" if self.needed else "on"


_read: dict[Path, tuple[int, list[Decision]]] = {}  # by needs.json: when it was written, and what it holds


def decisions(folder: Path) -> list[Decision]:
    """List a run's decisions on optional parts of the training (see `Decision`). Decisions without pictures are left out.

    Returns [] if needs.json is absent or broken. A training writes its decisions as soon as they are made, so this works before the
    training has ended.
    """
    file = folder / "needs.json"
    try:
        written = file.stat().st_mtime_ns
    except OSError:
        return []
    if file not in _read or _read[file][0] != written:  # a panel is drawn often
        _read[file] = written, _parse(folder, file)
    return _read[file][1]


def _parse(folder: Path, file: Path) -> list[Decision]:
    found = []
    try:
        for row in read_json(file):
            if shown := row.get("pictures"):
                files = {kind: folder / shown[kind] for kind in (*ON_OFF, "photo")}
                psnr = {kind: float(shown[f"psnr_{kind}"]) for kind in ON_OFF}
                found.append(
                    Decision(row["need"], row["what"], row["why"], bool(row["needed"]), shown["view"], files, psnr)
                )
    except (
        InputError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        OverflowError,
    ):  # of another release, or half copied
        return []
    return found


def find_decision(folder: Path, need: str) -> Decision:
    """Find a run's decision about the optional part `need`. Raises InputError where there is none."""
    for decision in decisions(folder):
        if decision.need == need:
            return decision
    raise InputError(f"{folder} has no decision about {need}: import the run again")


def open_decisions(scene: bpy.types.Scene, folder: Path) -> list[Decision]:
    """List a run's decisions that the artist has not confirmed in this scene."""
    known = next((known for known in scene.refgs.runs if Path(known.folder) == folder), None)
    confirmed = set(known.confirmed.split()) if known else set()
    return [decision for decision in decisions(folder) if f"{decision.need}={decision.answer}" not in confirmed]


def confirm(scene: bpy.types.Scene, folder: Path, need: str) -> None:
    """Note in the scene's list of runs that the artist agrees with a run's decision on the optional part `need` of the training.

    `open_decisions` then no longer lists the decision. Raises InputError if the run has no such decision with pictures.
    """
    decision = find_decision(folder, need)
    for known in scene.refgs.runs:
        if Path(known.folder) == folder:
            known.confirmed = " ".join({*known.confirmed.split(), f"{need}={decision.answer}"})
