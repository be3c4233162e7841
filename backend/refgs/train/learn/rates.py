"""Set the learning rates of an iteration: decay them, and freeze some parameters in some stages of the training."""

from refgs.train.start import GEOMETRY
from refgs.train.state import State
from refgs.train.timeline import since_propagation

REFLECTING = ("albedo", "metallic", "roughness", "indirect_dc", "indirect_rest", "environment", "exposure")


def set_rates(state: State, progress: float) -> None:
    """Set the learning rate of each tensor, at a progress of 0..1."""
    rates, late = state.settings.rates, state.residual_start
    frozen = _frozen(state, progress)
    for name in state.learned:
        decay = rates.decay**progress
        if name == "position":
            decay = rates.position_decay ** min(progress / rates.position_until, 1)
        elif name in REFLECTING:
            decay = rates.decay ** min(progress / late, 1)
        elif name == "sh_rest" and late < 1:
            decay = rates.decay ** (max(progress - late, 0) / (1 - late))
        state.learned.rates[name] = 0.0 if name in frozen else _start_rate(state, name) * decay


def _start_rate(state: State, name: str) -> float:
    if name == "sh_rest" and state.residual_start < 1:
        name = "residual"
    rate = getattr(state.settings.rates, name, 0.0)  # "received" is traced and does not learn
    return rate * state.capture.radius if name == "position" else rate


def _frozen(state: State, progress: float) -> set[str]:
    """Return the names of the parameters that do not learn in this iteration."""
    settings, frozen = state.settings, set()
    if state.from_hull and state.iteration < settings.train.light_first and state.method.deferred:
        frozen |= {*GEOMETRY}
    since = since_propagation(state)
    if since is not None and since < settings.propagation.rest:
        frozen |= {"opacity"}
    # Material and light have cooled when the residual starts to learn: they must not give way to it.
    if state.residual_start < 1 and progress >= state.residual_start:
        frozen |= {*REFLECTING}
    return frozen
