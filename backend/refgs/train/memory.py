"""A card's full memory: train on with fewer surfels."""

import torch

from refgs.errors import InputError
from refgs.train.densify import thin
from refgs.train.state import State

FEWER = 0.8  # of the surfels, where there is no memory for all
LEAST_SURFELS = 1000


def full_card() -> InputError:
    """Say what helps where a card's memory is too small."""
    return InputError("the card's memory is too small: close what else uses it, or take --device cpu")


def fewer_surfels(state: State) -> None:
    """Lower the budget and keep the most opaque surfels. Raises InputError where too few would be left."""
    budget = int(FEWER * len(state.parameters["position"]))
    if budget < LEAST_SURFELS:
        raise full_card() from None
    state.forget_gradients()
    torch.cuda.empty_cache()
    state.change("surfels.budget", budget, "memory", "the card's memory is full")
    thin(state.parameters, state.optimizer, budget)
    state.reset_motion()
    state.report("warning", {"what": f"the card's memory is full: going on with {budget:,} surfels at the most"})
