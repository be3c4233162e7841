"""Decide which optional parts of the training a scene needs. Such a part, for example inter-reflection, is called a need.

A decision compares a measured value with a threshold, and is recorded in needs.json. A part that is not needed is left out: settings,
parameters or photos are changed. The record says how much PSNR on training views this costs, and how many seconds of training it saves.
"""

import json
from typing import Any

from refgs.formats.needs import Found
from refgs.paths import write_text
from refgs.train.decide.iterations import Initial, Iterations
from refgs.train.decide.lighting import Degrees, Light, Reflections, share_hidden
from refgs.train.decide.materials import Constants, Specular
from refgs.train.decide.need import Decision, Given, Moment, Need
from refgs.train.decide.photos import Outside, Views
from refgs.train.decide.pictures import write_pictures
from refgs.train.state import State
from refgs.train.timeline import Step

CONSTANTS, SPECULAR = Constants(), Specular()
NEEDS: tuple[Need, ...] = (
    Views(), SPECULAR, Reflections(), Initial(), Iterations(), Outside(), Light(), Degrees(), CONSTANTS,
)  # fmt: skip
"""Needs that are due at the same moment are decided in this order."""

BY_NAME = {need.name: need for need in NEEDS}


def evaluate(state: State, moment: Moment, given: Given = Given()) -> list[str]:  # noqa: B008  (it is frozen)
    """Make the decisions about optional parts of the training (needs) that are due at this `moment`, such as "start" or "mesh".

    Returns the names of the needs on which a decision was made. `given` is passed on to `Need.measure`.
    """
    decided: list[str] = []
    for need in NEEDS:
        asked = moment in need.moments or need.follows in decided
        if not asked or need.name in state.needs or need.asked(state) == "on":
            continue
        if need.due(state, moment) and (decision := need.measure(state, given)):
            _record(state, need, decision)
            decided.append(need.name)
    return decided


def look_again(state: State, step: Step) -> None:
    """Bring back specular shading and what depends on it if the scene proves not matte."""
    if decision := SPECULAR.look_again(state):
        _bring_back_specular(state, decision)


def bring_back_specular(state: State, why: str) -> bool:
    """Bring back specular shading and what was left out with it. `why` is the reason, for the record.

    Returns False, and changes nothing, if specular shading is on already, or if the user's setting is not "auto".
    """
    if state.needed(SPECULAR.name) or SPECULAR.asked(state) != "auto":
        return False
    _bring_back_specular(state, Decision(True, why))
    return True


def _bring_back_specular(state: State, decision: Decision) -> None:
    _record(state, SPECULAR, decision)
    SPECULAR.undo(state, decision.why)
    _undo_following(state, state.needs, decision.why)


def _undo_following(state: State, decisions: dict[str, Found], why: str) -> None:
    """Undo decisions that followed from leaving out specular shading, unless the user set them."""
    for need in NEEDS:
        if need.follows == SPECULAR.name and need.name in decisions and need.asked(state) == "auto":
            del decisions[need.name]
            need.undo(state, why)


def reflections(state: State, step: Step) -> None:
    """Decide whether inter-reflection is needed, or report how much the object mirrors itself."""
    hidden = step.hidden or 0.0
    if not evaluate(state, "mesh", Given(step.done, hidden)):
        state.announce("reflections", f"with {Reflections.what}: {share_hidden(hidden)}", detail=True)


def _record(state: State, need: Need, decision: Decision) -> None:
    """Record and report a decision, and leave the part out if it is not needed."""
    figures: dict[str, Any] = {key: float(value) for key, value in decision.figures.items()}
    if decision.statistic is not None:
        threshold = need.threshold if decision.threshold is None else decision.threshold
        figures = {"statistic": float(decision.statistic), "threshold": float(threshold)} | figures
    found = Found(needed=decision.needed, why=decision.why, **figures)
    if decision.statistic is not None:
        found = found.model_copy(update={"pictures": write_pictures(state, need.name, found)})
    state.needs[need.name] = found
    if found.pictures:
        write_text(state.folder / "needs.json", json.dumps(rows(state), indent=1))
    what = f"{'with' if decision.needed else 'without'} {need.what}: {decision.why}"
    state.announce(need.name, what, detail=decision.needed or not need.shown)
    if not decision.needed:
        decision.once()
        need.apply(state, found)


def restore(state: State, recorded: dict[str, Found]) -> None:
    """Take over the decisions of a checkpoint, and leave out again the parts of the training that were not needed.

    `recorded` are the checkpoint's decisions by name. Decisions that this process made after the checkpoint stay.
    """
    before, now = (decisions.get(SPECULAR.name) for decisions in (recorded, state.needs))
    if before and now and now.needed and not before.needed:  # brought back after this checkpoint
        _undo_following(state, recorded, now.why)
    state.needs = recorded | state.needs
    for name, found in state.needs.items():
        if not found.needed:
            BY_NAME[name].apply(state, found)


def rows(state: State) -> list[dict[str, Any]]:
    """Return the decisions about optional parts of the training, as rows for needs.json."""
    listed = []
    for name, found in state.needs.items():
        row = {"need": name, "what": BY_NAME[name].what, **found.model_dump(exclude_none=True)}
        if not found.needed:
            row["saved"] = f"{found.seconds or 0:.1f} s, {found.megabytes or 0:.1f} MB"
            row |= {} if found.decibels is None else {"cost": f"{found.decibels:+.3f} dB"}
        listed.append(row)
    return listed
