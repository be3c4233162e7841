"""Guard a training against NaN and infinity: skip and count the steps that have them, and remove the surfels that have them."""

from collections.abc import Callable

import torch
from torch import Tensor

from refgs.errors import InputError
from refgs.model.learned import Learned
from refgs.train.learn.densify import Densification
from refgs.train.state import State

MOST_IN_A_ROW = 30  # steps in a row that may be skipped before the training goes back to a checkpoint


class Guard:
    """Skip and count the steps whose loss or gradients are not finite.

    The counts are kept on the training's device, so that the CPU need not wait for the graphics card.
    """

    def __init__(self, device: torch.device):
        self._counts = torch.zeros(3, device=device)  # skipped steps, in all and in a row; steps that were taken
        self._seen, self._said, self._gone_back, self._taken = 0, 0, -1, -1

    @torch.no_grad()
    def judge(self, loss: Tensor, learned: Learned) -> Tensor:
        """Return 1 if Adam may take this step, else 0, as a float32 scalar tensor.

        The step may be taken if the loss and the sum of all squared gradients are finite. Steps that may not be taken are counted.
        """
        size = torch.nn.utils.get_total_norm([*learned.gradients(), loss.detach()])
        accepted = size.isfinite().float()
        self._counts[:2] += 1 - accepted
        self._counts[1] *= 1 - accepted
        self._counts[2] += accepted
        return accepted

    @property
    def left_out(self) -> int:
        """Return how many steps were skipped since this process started."""
        return int(self._counts[0])

    def look(self, state: State, whole: bool, complete: Callable[[], list[int]]) -> str:
        """Look for numbers that are not finite: warn of skipped steps, and remove surfels that have such numbers.

        Nothing is checked unless steps were skipped since the last call, or `whole` is true. `complete` lists the iterations that have a
        complete checkpoint.

        The training must go back to its last checkpoint if light or exposures are not finite, or if too many steps in a row were skipped.
        Then the reason is returned, otherwise "". Raises InputError if there is no checkpoint, or if going back before did not help.
        """
        total, in_a_row, taken = (int(count) for count in self._counts.tolist())
        worse, self._seen = total > self._seen, total
        if not (worse or whole):
            return ""
        if total > 2 * self._said:  # warn when the count has doubled, not every ten iterations
            self._said = total
            warn(state, f"steps not taken so far, for the loss or a gradient was not finite: {total}")
        count = remove_broken(state.learned)
        if count:
            state.part(Densification).restart(state)
            warn(state, f"surfels removed, for they had numbers that are not finite: {count}")
        elsewhere = state.learned.keys() - state.learned.by_row.keys()
        lit = all(bool(state.learned[name].isfinite().all()) for name in elsewhere)
        if lit and (in_a_row < MOST_IN_A_ROW or count):
            return ""
        kept, what = complete(), f"{in_a_row} steps in a row were not finite" if lit else "the light is not finite"
        at = f"{what} at iteration {state.iteration}"
        advice = "train anew with lower rates (--set rates.…), or another seed (--set train.seed=1)"
        if not kept:
            raise InputError(f"{at}, and there is no checkpoint yet: {advice}")
        if kept[-1] == self._gone_back or taken == self._taken:
            raise InputError(f"{at}, again after going back to that of {kept[-1]}, which is whole: {advice}")
        self._gone_back, self._taken = kept[-1], taken
        self._counts[1] = 0
        return f"{at}: going back to that of {kept[-1]}"


def warn(state: State, what: str) -> None:
    """Report `what` as a warning, together with the current iteration."""
    state.report("warning", {"what": f"iteration {state.iteration}: {what}"})


@torch.no_grad()
def remove_broken(learned: Learned) -> int:
    """Remove surfels with non-finite numbers, and return how many; raise InputError if none remain."""
    finite = [value[:, None].flatten(1).isfinite().all(dim=1) for value in learned.by_row.values()]
    whole = torch.stack(finite).all(dim=0)
    count = int((~whole).sum())
    if count == len(whole):
        raise InputError("no surfel is finite any more: train anew with lower rates (--set rates.…)")
    if count:
        learned.rows(whole.nonzero()[:, 0])
    return count
