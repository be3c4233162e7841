"""Divide surfels where the picture needs more detail, remove faint ones, reset opacities, propagate normals."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from refgs.errors import TryAgain
from refgs.model.adam import Adam
from refgs.model.surfels import Parameters, activate, axes
from refgs.settings import DensifySettings, PropagationSettings, RateSettings
from refgs.train.start import AROUND
from refgs.train.state import State

RESET = 0.01  # opacity
SEEN = 0.2  # opacity from which on surfels explain a picture: nothing is decided, and no mesh is made, of fainter ones
FEWER = 0.8  # of the surfels, where there is no memory for all
LEAST_SURFELS = 1000


def faint_now(state: State, opacity: float = SEEN) -> bool:
    """Tell whether the last opacity reset was so recent that useful surfels may still be too transparent.

    An opacity reset makes all surfels nearly transparent. Useful surfels become opaque again as they learn, and this function estimates
    whether they have had enough iterations to reach `opacity`.
    """
    return faint(state.settings.densify, state.settings.rates, state.iteration, state.total, opacity)


def densify_due(state: State, progress: float) -> None:
    """Remove faint surfels and divide others, if this iteration is scheduled for it."""
    settings, budget = state.settings.densify, state.settings.surfels.budget
    if state.iteration % settings.every or progress < settings.start or faint_now(state, settings.prune_opacity):
        return
    gradient = state.motion.mean()
    if state.capture.box is not None:  # surfels beside the region get no more than their share of the budget
        wanted = state.wanted()
        ranked = torch.where(wanted, torch.inf, gradient).argsort(descending=True)
        count = int(wanted.sum())
        room = max(int(AROUND * budget) - (len(wanted) - count), 0)
        gradient[ranked[count + room :]] = 0
    with state.clock.part("densification"):
        densify(state.parameters, state.optimizer, gradient, settings, budget, divide=progress < settings.stop)
    state.reset_motion()


def since_propagation(state: State) -> int | None:
    """Count the iterations since normals were last propagated (see `propagate_normals`).

    Returns None before the first propagation, and once the training no longer propagates normals.
    """
    settings, iteration = state.settings.propagation, state.iteration
    if not settings.every or iteration < settings.every or not state.method.lit:
        return None
    last = iteration // settings.every * settings.every
    return iteration - last if last / state.total < settings.stop else None


def reshape_due(state: State) -> None:
    """Propagate normals or reset opacities, if this iteration is scheduled for it."""
    settings, iteration = state.settings.densify, state.iteration
    if since_propagation(state) == 0:
        with state.clock.part("densification"):
            propagate_normals(state.constant | state.parameters, state.optimizer, state.settings.propagation)
    elif settings.reset_every and iteration % settings.reset_every == 0 and iteration / state.total < settings.stop:
        reset_opacity(state.parameters, state.optimizer)


@torch.no_grad()
def densify(
    parameters: Parameters,
    optimizer: Adam,
    gradient: Tensor,
    settings: DensifySettings,
    budget: int,
    divide: bool,
) -> int:
    """Remove faint surfels. If `divide` is true, also divide the surfels with the largest screen gradients, up to `budget` surfels in all.

    `gradient` (N,) is each surfel's screen gradient. A surfel is divided into two halves along its longer axis. Parameters are replaced in
    the dictionary and in the optimiser. The halves start with zero Adam moments; other surfels keep theirs. At least one surfel is kept.
    Returns how many surfels were divided.
    """
    opacity = parameters["opacity"].sigmoid()
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
    index = torch.cat([kept, chosen])  # each chosen one stands twice
    if len(index) == len(keep) and len(chosen) == 0:
        return 0
    halves = torch.isin(kept, chosen).nonzero()[:, 0], torch.arange(len(kept), len(index), device=keep.device)
    take(parameters, optimizer, index, halves)
    if len(chosen):
        _divide(parameters, *halves)
    return len(chosen)


@torch.no_grad()
def reset_opacity(parameters: Parameters, optimizer: Adam) -> None:
    """Lower all opacities to RESET at most (Kerbl et al. 2023).

    Training then raises the opacities of the surfels that the picture needs. The other surfels stay faint and are removed later.
    """
    parameters["opacity"].clamp_(max=math.log(RESET / (1 - RESET)))
    optimizer.state.pop(parameters["opacity"], None)


def faint(settings: DensifySettings, rates: RateSettings, iteration: int, total: int, opacity: float) -> bool:
    """Tell whether the last opacity reset before `iteration` was so recent that useful surfels may still be too transparent.

    An opacity reset makes all surfels nearly transparent. Useful surfels become opaque again as they learn. The time until they reach
    `opacity` is estimated: in each iteration, Adam moves an opacity's logit by about the learning rate, which decays. The function returns
    true until four times this estimate has passed. `total` is the number of iterations of the training.
    """
    every = settings.reset_every
    last = min(iteration, math.ceil(settings.stop * total)) - 1  # a reset at the end of this iteration does not count
    if not every or last < every:
        return False
    since, decay = last // every * every, rates.decay
    iterations = (
        iteration - since
        if decay == 1
        else total * (decay ** (since / total) - decay ** (iteration / total)) / -math.log(decay)
    )
    opacity = max(opacity, RESET)
    return iterations * rates.opacity < 4 * math.log(opacity / (1 - opacity) * (1 - RESET) / RESET)


@torch.no_grad()
def propagate_normals(parameters: Parameters, optimizer: Adam, settings: PropagationSettings) -> None:
    """Propagate normals from mirror-like surfels to the surfels around them (Ref-Gaussian paper, §3.3).

    Smooth, metallic surfels are enlarged, and all opacities are raised to at least `settings.opacity`. The enlarged surfels then cover
    their neighbours' pixels, which are shaded with the enlarged surfels' normals. Further training adapts the neighbours to these normals.
    """
    parameters["opacity"].clamp_(min=math.log(settings.opacity / (1 - settings.opacity)))
    optimizer.state.pop(parameters["opacity"], None)
    surfels = activate(parameters)
    mirrors = (surfels.metallic >= settings.metallic) & (surfels.roughness <= settings.roughness)
    parameters["scale"] += math.log(settings.growth) * mirrors[:, None]


@torch.no_grad()
def thin(parameters: Parameters, optimizer: Adam, count: int) -> None:
    """Keep the `count` most opaque surfels."""
    take(parameters, optimizer, parameters["opacity"].topk(count).indices.sort().values)


def full_card() -> TryAgain:
    """Return the TryAgain to raise if the graphics card has too little memory. Its message tells the user what to do."""
    return TryAgain("the card's memory is too small: close what else uses it, or take --device cpu")


def fewer_surfels(state: State) -> None:
    """Keep only the most opaque surfels, the fraction FEWER of all, because the graphics card's memory is full.

    The surfel budget is lowered to the same number. Raises TryAgain if fewer than LEAST_SURFELS would be left.
    """
    budget = int(FEWER * len(state.parameters["position"]))
    if budget < LEAST_SURFELS:
        raise full_card()
    state.forget_gradients()
    torch.cuda.empty_cache()
    state.change("surfels.budget", budget, "memory", "the card's memory is full")
    thin(state.parameters, state.optimizer, budget)
    state.reset_motion()
    state.report("warning", {"what": f"the card's memory is full: going on with {budget:,} surfels at the most"})


def take(parameters: Parameters, optimizer: Adam, index: Tensor, fresh: Sequence[Tensor] = ()) -> None:
    """Replace all surfels by the rows `index` of their parameters. A row may be taken more than once.

    Each row keeps its Adam moments. Only the rows whose indices in the result are in `fresh` start with zero moments. Adam then moves
    these rows faster than others at first. Pictures get worse for a while, but for captures without masks, the final result is better. If
    memory runs out, all surfels stay as they were.
    """
    groups = [group for group in optimizer.param_groups if group["name"] in parameters]  # without light and exposures
    made = []
    for group in groups:
        old = group["params"][0]
        new, state = old.detach()[index].requires_grad_(), dict(optimizer.state.get(old, {}))
        for key in ("exp_avg", "exp_avg_sq") if state else ():
            state[key] = state[key][index]
            for rows in fresh:
                state[key][rows] = 0
        made.append((new, state))
    for group, (new, state) in zip(groups, made, strict=True):
        optimizer.state.pop(group["params"][0], None)
        group["params"][0] = parameters[group["name"]] = new
        if state:
            optimizer.state[new] = state


def _divide(parameters: Parameters, first: Tensor, second: Tensor) -> None:
    """Make two halves of each divided surfel, so that together they cover what it covered.

    The rows `first` and `second` of the parameters hold two equal copies of each surfel. Move the copies apart along the longer axis, and
    shorten them along it.
    """
    scale = parameters["scale"][first]
    longer = scale.argmax(dim=1)
    rows = torch.arange(len(first), device=first.device)
    sigma = scale[rows, longer].exp()
    axis = torch.stack(axes(parameters["rotation"][first]))[longer, rows]
    # Two Gaussians of 0.8 σ, 0.6 σ either side of the centre: the same variance as the one, 0.8² + 0.6² = 1.
    for half, sign in ((first, 1.0), (second, -1.0)):
        parameters["position"][half] += sign * 0.6 * sigma[:, None] * axis
        parameters["scale"][half, longer] = scale[rows, longer] + math.log(0.8)
