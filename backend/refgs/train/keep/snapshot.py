"""Save and restore the state of a training: everything that the next iteration depends on."""

from pathlib import Path

import torch

from refgs.errors import InputError
from refgs.formats.checkpoint import Facts
from refgs.formats.validate import validated
from refgs.model.learned import belong_together
from refgs.train.decide import needs
from refgs.train.keep import checkpoint
from refgs.train.keep.earlier import as_of_today
from refgs.train.part import Fact
from refgs.train.state import State


def save(state: State) -> None:
    """Write a checkpoint into the run folder."""
    tensors = state.learned.save()
    parts: dict[str, dict[str, Fact]] = {}
    for part in state.parts.values():
        found = part.facts(state)
        own = {f"{part.name}.{name}": value for name, value in found.items() if isinstance(value, torch.Tensor)}
        tensors |= own
        parts[part.name] = {name: value for name, value in found.items() if f"{part.name}.{name}" not in own}
    facts = {"seconds": state.seconds, "total": state.total, "initial": state.initial, "residual": state.residual}
    facts |= {"clock": state.clock.seconds, "spent": state.plan.spent, "processor_seconds": state.clock.processor}
    found = {name: found.model_dump(exclude_none=True) for name, found in state.needs.items()}
    facts |= {"decided": state.decided, "details": sorted(state.decided.details), "needs": found, "parts": parts}
    checkpoint.save(state.folder / "checkpoints", state.iteration, tensors, facts)


def restore(state: State, run: Path) -> None:
    """Restore `state` from the last checkpoint in the run folder `run` that is complete and not damaged.

    Raises `checkpoint.NoCheckpoint` if there is none, and InputError if this release of RefGS cannot use it.
    """
    tensors, tables = as_of_today(*checkpoint.load(run / "checkpoints", state.report), state.method.light)
    facts = validated(tables, Facts, str(run / "checkpoints"), "Train again into a new folder.")
    if not belong_together(tensors):
        raise InputError(f"{run / 'checkpoints'}: the tensors of the checkpoint do not belong together: train again")
    state.total = facts.total
    needs.restore(state, facts.needs)
    tensors = {name: value.to(state.device) for name, value in tensors.items()}
    state.iteration, state.seconds = facts.iteration, facts.seconds
    state.clock.resume(facts.clock, facts.processor_seconds)
    state.plan.before = facts.spent
    state.initial = state.initial if facts.initial is None else facts.initial
    state.residual = facts.residual
    for about, what in facts.decided.items():
        state.announce(about, what, about in facts.details)
    try:
        state.learned.load(tensors)
        for part in state.parts.values():
            prefix = f"{part.name}."
            own = {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
            part.restore(state, facts.parts.get(part.name, {}) | own)
    except KeyError:
        raise InputError(f"{run} was begun by another release of RefGS: train again into a new folder") from None
