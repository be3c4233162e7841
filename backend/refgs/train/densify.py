"""Adding surfels where the picture asks for them, and removing those that nobody sees."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from refgs.camera import Camera
from refgs.clock import timed
from refgs.kernels.layout import struct
from refgs.kernels.load import check, run
from refgs.model.surfels import Parameters, activate, axes
from refgs.settings import DensifySettings, PropagationSettings, RateSettings
from refgs.train.adam import Adam

RESET = 0.01  # opacity


_Work = struct("Motion", "motion.cpp")


class ScreenGradient:
    """Mean gradient of the loss by a surfel's motion on the screen, in half image widths (as 3D Gaussian splatting counts it)."""

    def __init__(self, count: int, device: torch.device):
        self.total = torch.zeros(count, device=device)
        self.views = torch.zeros(count, device=device)

    @timed("densification")
    @torch.no_grad()
    def add(self, position: Tensor, gradient: Tensor, camera: Camera, accepted: Tensor | None = None) -> None:
        """Account for one view's gradient (N, 3) by the world position (N, 3), unless `accepted`, a float32 scalar, is zero."""
        surfels = len(self.total)
        check(total=(self.total, (surfels,)), position=(position, (surfels, 3)), gradient=(gradient, (surfels, 3)))
        position, gradient, work = position.contiguous(), gradient.contiguous(), _Work(count=len(position))
        work.view[:], work.scale = camera.world_to_camera[:3].reshape(-1).tolist(), camera.width / 2 / camera.fx
        work.attach(positions=position, gradients=gradient, total=self.total, views=self.views)
        if accepted is not None:
            work.attach(accepted=accepted)
        run("refgs_motion", work, position, items=work.count)

    def mean(self) -> Tensor:
        """(N,), zero where a surfel was never seen."""
        return self.total / self.views.clamp_min(1)


@torch.no_grad()
def densify(
    parameters: Parameters,
    optimizer: Adam,
    gradient: Tensor,
    settings: DensifySettings,
    budget: int,
    divide: bool,
) -> int:
    """Remove faint surfels; divide those with the largest screen gradient in two along their longer axis, up to the budget.

    Parameters are replaced in the dictionary and in the optimiser; the moments of the survivors are kept, those of the
    new ones are zero. Returns how many were divided. At least one surfel is kept.
    """
    opacity = parameters["opacity"].sigmoid()
    keep = ~(opacity < settings.prune_opacity)  # one that is no number is guard.py's to remove, and to say so
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
    """Make all surfels faint: those that the picture needs come back, the others are removed later (Kerbl et al. 2023)."""
    parameters["opacity"].clamp_(max=math.log(RESET / (1 - RESET)))
    optimizer.state.pop(parameters["opacity"], None)


def faint(settings: DensifySettings, rates: RateSettings, iteration: int, total: int, opacity: float) -> bool:
    """Whether surfels were made faint so lately that, with opacity's rate, those that the picture needs may not be back at an `opacity`.
    Adam moves a logit by about its rate, which decays, in an iteration that sees the surfel; they get four times as long as that takes."""
    every = settings.reset_every
    last = min(iteration, math.ceil(settings.stop * total)) - 1  # not what is done at the end of this iteration
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
    """Have what mirrors grow over what surrounds it, all of it being opaque (paper §3.3). The surfels in front then lend their
    normals to the pixels around, and the others give way or follow."""
    parameters["opacity"].clamp_(min=math.log(settings.opacity / (1 - settings.opacity)))
    optimizer.state.pop(parameters["opacity"], None)
    surfels = activate(parameters)
    mirrors = (surfels.metallic >= settings.metallic) & (surfels.roughness <= settings.roughness)
    parameters["scale"] += math.log(settings.growth) * mirrors[:, None]


@torch.no_grad()
def thin(parameters: Parameters, optimizer: Adam, count: int) -> None:
    """Keep this many surfels, the most opaque."""
    take(parameters, optimizer, parameters["opacity"].topk(count).indices.sort().values)


def take(parameters: Parameters, optimizer: Adam, index: Tensor, fresh: Sequence[Tensor] = ()) -> None:
    """Replace the surfels by those of an index, with their moments; those at `fresh` begin without. Adam's steps of these are then
    several times its rate for a while, which sets the picture back at first but finds them their places: a capture without masks
    ends better for it. All of them or, where there is no memory for that, none."""
    groups = [group for group in optimizer.param_groups if group["name"] in parameters]  # not the light
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
    """Move two copies apart along the longer axis, so that together they cover what the one did."""
    scale = parameters["scale"][first]
    longer = scale.argmax(dim=1)
    rows = torch.arange(len(first), device=first.device)
    sigma = scale[rows, longer].exp()
    axis = torch.stack(axes(parameters["rotation"][first]))[longer, rows]
    # Two Gaussians of 0.8 σ, 0.6 σ either side of the centre: the same variance as the one, 0.8² + 0.6² = 1.
    for half, sign in ((first, 1.0), (second, -1.0)):
        parameters["position"][half] += sign * 0.6 * sigma[:, None] * axis
        parameters["scale"][half, longer] = scale[rows, longer] + math.log(0.8)
