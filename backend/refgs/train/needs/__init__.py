"""Decide which needs a scene has. A need is a part of the method that a scene may do without.

Each decision compares a figure of the training with a threshold, and is recorded in needs.json. If a part is not needed, settings,
parameters and photos are changed accordingly. The decision's cost is the PSNR that training views lose without the part. Its saving is the
seconds that an iteration saves, times the iterations that were left.
"""

from typing import Any

from refgs.train.densify import faint_now
from refgs.train.needs.lighting import Degrees, Light, Reflections, share_hidden
from refgs.train.needs.materials import Constants, Specular
from refgs.train.needs.need import Decision, Moment, Need
from refgs.train.needs.photos import WHOLE_EVERY, Outside, Views, time_crops
from refgs.train.needs.schedule import Initial, Iterations
from refgs.train.state import State

CONSTANTS = Constants()
NEEDS: tuple[Need, ...] = (
    Views(),
    Specular(),
    Reflections(),
    Initial(),
    Iterations(),
    Outside(),
    Light(),
    Degrees(),
    CONSTANTS,
)
"""In the order in which those of one moment are decided."""

BY_NAME = {need.name: need for need in NEEDS}

__all__ = [
    "BY_NAME",
    "CONSTANTS",
    "NEEDS",
    "WHOLE_EVERY",
    "evaluate_due",
    "evaluate_iteration",
    "evaluate_mesh",
    "restore",
    "rows",
]


def evaluate_due(state: State, moment: Moment, *given: Any, progress: float = 0.0) -> list[str]:
    """Decide the needs (parts of the method that a scene may do without) that are due at a moment of the training (see `Moment`).

    Returns the names of the needs decided. `given` is passed on to `Need.measure`. `progress` is 0..1.
    """
    decided: list[str] = []
    for need in NEEDS:
        asked = moment in need.moments or need.follows in decided
        if not asked or need.name in state.needs or need.asked(state) == "on":
            continue
        if need.due(state, moment, progress) and (decision := need.measure(state, *given)):
            _record(state, need, decision)
            decided.append(need.name)
    return decided


def evaluate_iteration(state: State, progress: float) -> None:
    """Decide the needs (parts of the method that a scene may do without) that are due after an iteration."""
    if state.initial or not state.method.deferred or state.settings.render.diffuse != "irradiance" or faint_now(state):
        return
    time_crops(state)
    evaluate_due(state, "iteration", progress=progress)


def evaluate_mesh(state: State, hidden: float) -> None:
    """Decide, once there is a mesh, whether inter-reflection is needed.

    If it is decided already, only report how much the object mirrors itself. `hidden` is the fraction of the object's pixels that mirror
    the object.
    """
    if not evaluate_due(state, "mesh", hidden):
        state.announce("reflections", f"with {Reflections.what}: {share_hidden(hidden)}")


def _record(state: State, need: Need, decision: Decision) -> None:
    """Record and announce the decision about a need. If this part of the method is not needed, leave it out."""
    found: dict[str, Any] = {"needed": decision.needed, "why": decision.why}
    if decision.statistic is not None:
        found["statistic"] = float(decision.statistic)
        found["threshold"] = float(need.threshold if decision.threshold is None else decision.threshold)
    state.needs[need.name] = found | {key: float(value) for key, value in decision.figures.items()}
    state.announce(need.name, f"{'with' if decision.needed else 'without'} {need.what}: {decision.why}")
    if not decision.needed:
        decision.once()
        need.apply(state, state.needs[need.name])


def restore(state: State, recorded: dict[str, dict[str, Any]]) -> None:
    """Take over the decisions `recorded` in a checkpoint, and leave out again the parts of the method that are not needed.

    If the training goes back to an earlier checkpoint, decisions made after that checkpoint stay.
    """
    state.needs = recorded | state.needs
    for name, found in state.needs.items():
        if not found["needed"]:
            BY_NAME[name].apply(state, found)


def rows(state: State) -> list[dict[str, Any]]:
    """List the decisions about needs as rows of needs.json."""
    listed = []
    for name, found in state.needs.items():
        row = {"need": name, "what": BY_NAME[name].what, **found}
        if not found["needed"]:
            row["saved"] = f"{found.get('seconds', 0):.1f} s, {found.get('megabytes', 0):.1f} MB"
            row |= {"cost": f"{found['decibels']:+.3f} dB"} if "decibels" in found else {}
        listed.append(row)
    return listed
