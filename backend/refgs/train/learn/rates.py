"""Set the learning rates of an iteration: decay them, and freeze some parameters in some stages of the training."""

from refgs.train.state import State
from refgs.train.timeline import FROZEN, REFLECTING, Step


def set_rates(state: State, step: Step) -> None:
    """Set each learned tensor's learning rate for this iteration, 0 while it is frozen."""
    rates, late, progress = state.settings.rates, state.residual_start, step.progress
    frozen = {name for names, row in FROZEN if row.due(state, step) for name in names}
    for name in state.learned:
        decay = rates.decay**progress
        if name == "position":
            decay = rates.position_decay ** min(progress / rates.position_until, 1)
        elif name in REFLECTING:
            # Rates of materials and light have decayed when the residual starts to learn: they must not give way to it.
            decay = rates.decay ** min(progress / late, 1)
        elif name == "sh_rest" and late < 1:
            decay = rates.decay ** (max(progress - late, 0) / (1 - late))
        state.learned.rates[name] = 0.0 if name in frozen else _start_rate(state, name) * decay


def _start_rate(state: State, name: str) -> float:
    if name == "sh_rest" and state.residual_start < 1:
        name = "residual"
    rate = getattr(state.settings.rates, name, 0.0)  # "received" is traced and does not learn
    return rate * state.capture.radius if name == "position" else rate
