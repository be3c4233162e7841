"""Divide surfels where the picture needs more detail, remove faint ones, reset opacities, propagate normals."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from refgs.capture.first_points import AROUND
from refgs.errors import TryAgain
from refgs.model.learned import Learned
from refgs.model.surfels import activate, axes
from refgs.render.screen_gradient import ScreenGradient
from refgs.settings import DensifySettings
from refgs.train.part import Fact, Part
from refgs.train.state import State
from refgs.train.timeline import DIVIDE, RESET, Step

LEFT_SURFELS = 0.8  # fraction of the surfels that stays if memory is full
LEAST_LEFT = 1000


class Densification(Part):
    """Remember each surfel's mean screen gradient (see `ScreenGradient`)."""

    name = "densification"

    def __init__(self) -> None:
        self.gradient = ScreenGradient(0, torch.device("cpu"))

    def start(self, state: State) -> None:
        self.restart(state)

    def restart(self, state: State) -> None:
        """Start new means of the screen gradients, all zero, after surfels have been replaced."""
        self.gradient = ScreenGradient(state.learned.count, state.device)

    def facts(self, state: State) -> dict[str, Fact]:
        return {"total": self.gradient.total, "views": self.gradient.views}

    def restore(self, state: State, facts: Mapping[str, Any]) -> None:
        self.restart(state)
        self.gradient.total, self.gradient.views = facts["total"], facts["views"]


def watch(state: State, step: Step, accepted: Tensor) -> None:
    """Add this step's gradients to the mean screen gradients, unless the scalar `accepted` is 0."""
    position, gradient = state.learned["position"], state.part(Densification).gradient
    if position.grad is not None:
        gradient.add(position.detach(), position.grad, state.photos[step.view].camera, accepted)


def prune_and_divide(state: State, step: Step) -> None:
    """Remove faint surfels, and divide surfels with large screen gradients until `densify.stop`."""
    settings, budget = state.settings.densify, state.settings.surfels.budget
    gradient = state.part(Densification).gradient.mean()
    if state.capture.box is not None:  # surfels outside the region may fill only the fraction AROUND of the budget
        wanted = state.wanted()
        ranked = torch.where(wanted, torch.inf, gradient).argsort(descending=True)
        count = int(wanted.sum())
        room = max(int(AROUND * budget) - (len(wanted) - count), 0)
        gradient[ranked[count + room :]] = 0
    with state.clock.part("densification"):
        densify(state.learned, gradient, settings, budget, divide=DIVIDE.due(state, step))
    state.part(Densification).restart(state)


@torch.no_grad()
def densify(learned: Learned, gradient: Tensor, settings: DensifySettings, budget: int, divide: bool) -> int:
    """Remove faint surfels. If `divide` is true, also divide the surfels with the largest screen gradients, up to `budget` surfels in all.

    `gradient` (N,) is each surfel's screen gradient. A surfel is divided into two halves along its longer axis. The halves start with
    zero Adam moments; other surfels keep theirs. At least one surfel is kept. Returns how many surfels were divided.
    """
    opacity = learned["opacity"].sigmoid()
    keep = ~(opacity < settings.prune_opacity)  # NaN is kept here: guard.py removes it, with a warning
    if not keep.any():
        keep[opacity.argmax()] = True
    chosen = torch.zeros(0, dtype=torch.long, device=keep.device)
    if divide:
        candidates = torch.where(keep, gradient, -1.0)
        room = max(budget - int(keep.sum()), 0)
        count = min(room, int((candidates > settings.gradient).sum()))
        chosen = candidates.topk(count).indices.sort().values
    kept = torch.nonzero(keep)[:, 0]
    index = torch.cat([kept, chosen])  # each surfel to divide is taken twice
    if len(index) == len(keep) and len(chosen) == 0:
        return 0
    halves = torch.isin(kept, chosen).nonzero()[:, 0], torch.arange(len(kept), len(index), device=keep.device)
    learned.rows(index, halves)
    if len(chosen):
        _divide(learned, *halves)
    return len(chosen)


@torch.no_grad()
def reset_opacity(state: State, step: Step) -> None:
    """Lower all opacities to RESET at most (Kerbl et al. 2023).

    Training then raises the opacities of the surfels that the picture needs. The other surfels stay faint and are removed later.
    """
    state.learned.fill("opacity", state.learned["opacity"].clamp(max=math.log(RESET / (1 - RESET))))


@torch.no_grad()
def propagate_normals(state: State, step: Step) -> None:
    """Propagate normals from mirror-like surfels to the surfels around them (Ref-Gaussian paper, §3.3).

    Smooth, metallic surfels are enlarged, and all opacities are raised to at least `propagation.opacity`. The enlarged surfels then cover
    their neighbours' pixels, which are shaded with the enlarged surfels' normals. Further training adapts the neighbours to these normals.
    """
    learned, settings = state.learned, state.settings.propagation
    learned.fill("opacity", learned["opacity"].clamp(min=math.log(settings.opacity / (1 - settings.opacity))))
    surfels = activate(learned.constant | learned.by_row)
    mirrors = (surfels.metallic >= settings.metallic) & (surfels.roughness <= settings.roughness)
    learned["scale"].add_(math.log(settings.growth) * mirrors[:, None])


@torch.no_grad()
def thin(learned: Learned, count: int) -> None:
    """Remove all surfels except the `count` most opaque ones."""
    learned.rows(learned["opacity"].topk(count).indices.sort().values)


def full_card() -> TryAgain:
    """Return the exception to raise if the graphics card has too little memory."""
    return TryAgain("the card's memory is too small: close what else uses it, or take --device cpu")


def fewer_surfels(state: State) -> None:
    """Keep only the most opaque surfels, the fraction LEFT_SURFELS of all, because the graphics card's memory is full.

    The surfel budget is lowered to the same number. Raises TryAgain if fewer than LEAST_LEFT would be left.
    """
    budget = int(LEFT_SURFELS * state.learned.count)
    if budget < LEAST_LEFT:
        raise full_card()
    state.learned.forget_gradients()
    torch.cuda.empty_cache()
    state.change("surfels.budget", budget, "memory", "the card's memory is full")
    thin(state.learned, budget)
    state.part(Densification).restart(state)
    state.report("warning", {"what": f"the card's memory is full: going on with {budget:,} surfels at the most"})


def _divide(learned: Learned, first: Tensor, second: Tensor) -> None:
    """Turn each surfel's two copies, in rows `first` and `second` (D,), into its halves."""
    # The copies are moved apart and shortened along the surfel's longer axis, so that together they cover what it did.
    scale = learned["scale"][first]
    longer = scale.argmax(dim=1)
    rows = torch.arange(len(first), device=first.device)
    sigma = scale[rows, longer].exp()
    axis = torch.stack(axes(learned["rotation"][first]))[longer, rows]
    # Two Gaussians of 0.8 σ, each 0.6 σ from the centre, have the variance of the divided one: 0.8² + 0.6² = 1.
    for half, sign in ((first, 1.0), (second, -1.0)):
        learned["position"][half] += sign * 0.6 * sigma[:, None] * axis
        learned["scale"][half, longer] = scale[rows, longer] + math.log(0.8)
