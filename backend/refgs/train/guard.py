"""Steps that would not be finite are not taken, and are counted; surfels that are not finite are removed."""

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from refgs.errors import InputError
from refgs.model.adam import Adam
from refgs.model.surfels import Parameters
from refgs.train import checkpoint
from refgs.train.densify import ScreenGradient, take

if TYPE_CHECKING:
    from refgs.train.trainer import Trainer

MOST_IN_A_ROW = 30  # steps that may be left out before the training goes back
LOGIT = 12.0  # beyond, a logistic function's ends are nearer than float32 tells, and its slope says nothing
LIMITS = {
    "opacity": (-LOGIT, LOGIT),
    "albedo": (-LOGIT, LOGIT),
    "roughness": (-LOGIT, LOGIT),
    "metallic": (-LOGIT / 2, LOGIT / 2),  # nears its ends, and its slope zero, as the square
    "exposure": (-LOGIT, LOGIT),  # natural logarithms: 17 stops
}
DARKEST, BRIGHTEST = (
    -LOGIT,
    1e8,
)  # raw light: softplus' slope is the radiance in the dark; beyond, sums lose what is small
SMALLEST, LARGEST = 1e-6, 1e2  # of a surfel, in scene radii


def limits(name: str, radius: float, display: bool) -> tuple[float, float]:
    """What the raw values of a parameter are kept within, in a scene of this radius: as far as their gradients say which way is back."""
    if name == "scale":
        return math.log(SMALLEST * radius), math.log(LARGEST * radius)
    if name == "environment":
        return DARKEST, LOGIT if display else BRIGHTEST
    return LIMITS.get(name, (-math.inf, math.inf))


class Guard:
    """Counts, where the training is, the steps that were not taken: a card need not wait for them."""

    def __init__(self, device: torch.device):
        self._counts = torch.zeros(3, device=device)  # left out, in all and in a row; taken
        self._seen, self._said, self._gone_back, self._taken = 0, 0, -1, -1

    @torch.no_grad()
    def judge(self, loss: Tensor, optimizer: Adam) -> Tensor:
        """1 where the loss and all gradients are finite, and their squares, which Adam sums up; else 0, and counted. A float32 scalar."""
        gradients = [
            value.grad for group in optimizer.param_groups for value in group["params"] if value.grad is not None
        ]
        size = torch.nn.utils.get_total_norm([*gradients, loss.detach()])
        accepted = size.isfinite().float()
        self._counts[:2] += 1 - accepted
        self._counts[1] *= 1 - accepted
        self._counts[2] += accepted
        return accepted

    @property
    def left_out(self) -> int:
        """How many steps, of this process."""
        return int(self._counts[0])

    def look(self, trainer: "Trainer", whole: bool) -> None:
        """Where steps were left out, or the `whole` of the numbers is to be looked at: say so, and remove surfels that are not finite.
        Where that does not help, go back to the last checkpoint. Raises InputError where there is none, or the training has gone back
        to it before."""
        total, in_a_row, taken = (int(count) for count in self._counts.tolist())
        worse, self._seen = total > self._seen, total
        if not (worse or whole):
            return
        if total > 2 * self._said:  # each time there are twice as many: a line every ten iterations says no more
            self._said = total
            _warn(trainer, f"steps not taken so far, for the loss or a gradient was not finite: {total}")
        count = remove_broken(trainer.parameters, trainer.optimizer)
        if count:
            trainer.motion = ScreenGradient(len(trainer.parameters["position"]), trainer.device)
            _warn(trainer, f"surfels removed, for they had numbers that are not finite: {count}")
        elsewhere = [
            group["params"][0] for group in trainer.optimizer.param_groups if group["name"] not in trainer.parameters
        ]
        lit = all(bool(value.isfinite().all()) for value in elsewhere)
        if lit and (in_a_row < MOST_IN_A_ROW or count):
            return
        at, kept = trainer.iteration, checkpoint.complete(trainer.folder / "checkpoints")
        what = f"{in_a_row} steps in a row were not finite" if lit else "the light is not finite"
        advice = "train anew with lower rates (--set rates.…), or another seed (--set train.seed=1)"
        if not kept:
            raise InputError(f"{what} at iteration {at}, and there is no checkpoint yet: {advice}")
        if kept[-1] == self._gone_back or taken == self._taken:
            raise InputError(
                f"{what} at iteration {at}, again after going back to that of {kept[-1]}, which is whole: {advice}"
            )
        self._gone_back, self._taken = kept[-1], taken
        spent = trainer.seconds, dict(trainer.clock.seconds), trainer.plan.before
        trainer.resume()
        trainer.seconds, trainer.clock.seconds, trainer.plan.before = spent
        self._counts[1] = 0
        _warn(trainer, f"{what} at iteration {at}: going back to that of {kept[-1]}")


def _warn(trainer: "Trainer", what: str) -> None:
    trainer.report("warning", {"what": f"iteration {trainer.iteration}: {what}"})


@torch.no_grad()
def remove_broken(parameters: Parameters, optimizer: Adam) -> int:
    """Remove surfels with a number that is not finite; returns how many. Raises InputError where none would be left."""
    whole = torch.stack(
        [value.flatten(1).isfinite().all(dim=1) for value in (v[:, None] for v in parameters.values())]
    ).all(dim=0)
    count = int((~whole).sum())
    if count == len(whole):
        raise InputError("no surfel is finite any more: train anew with lower rates (--set rates.…)")
    if count:
        take(parameters, optimizer, whole.nonzero()[:, 0])
    return count


def running(mean: Tensor, figure: Tensor) -> Tensor:
    """A running mean with one more figure, which is left out where it is not finite."""
    known = torch.where(mean.isfinite(), figure + 0.95 * (mean - figure), figure)
    return torch.where(figure.isfinite(), known, mean)
