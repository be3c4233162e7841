"""Continue a finished training with hints: parts of the surface that a user says are metal or paint.

Photos of a mirror often have two explanations: a chrome egg at night mirrors darkness, and looks like black plastic. Training keeps the
explanation that it finds first, even if the other one fits better, because pictures get worse on the way from one to the other.
"""

from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs

from refgs.errors import InputError
from refgs.formats.hints import KINDS, Hint
from refgs.formats.splats import read_splats
from refgs.settings import Settings
from refgs.train.decide import needs
from refgs.train.keep import snapshot
from refgs.train.keep.progress import Means
from refgs.train.material import metals
from refgs.train.start import start_appearance
from refgs.train.state import State

AGAIN = 0.4  # progress to start from again: surfels lie on the surface, light and materials still learn fast
AT_MOST = 1.8  # minutes, unless the user gives a time: with the program's start, an artist waits two
# Hinted metals start bright and smooth: photos tell this kind of metal from paint least.
MIRROR = {"albedo": 0.8, "roughness": 0.1}


def continue_with_hints(state: State, run: Path, hints: list[Hint]) -> None:
    """Load the last checkpoint of a finished `run`, go back to an earlier iteration, and fix the metallic values of the hinted parts.

    Hinted metals start as a bright mirror, because the base colour that they learned as plastic is of no use. Hinted paint keeps the base
    colour and roughness that it learned as metal, because rough metal looks much like paint of its colour. The residual (see
    `State.residual_start`) is reset for all surfels.

    Raises InputError if the run has no checkpoint, or if its settings leave out metals.
    """
    snapshot.restore(state, run)
    if "metallic" not in state.learned and not needs.bring_back_specular(state, "hints say what is metal"):
        raise InputError(f"{run} was trained with settings that leave out metals: train it without them first")
    settings = state.settings
    kinds = hinted_kinds(state, read_splats(run / "splats.ply").positions, hints)
    _go_back(state)
    metals.hold_as(state, kinds)
    mirror = settings.model_copy(update={"surfels": settings.surfels.model_copy(update=MIRROR)})
    _restart(state, ("albedo", "roughness"), kinds == KINDS.index("metal"), mirror)
    _restart(state, ("sh_rest",), torch.ones_like(kinds, dtype=torch.bool), settings)
    state.residual, state.part(Means).values = False, {}
    part = {kind: float((kinds == number).float().mean()) for number, kind in enumerate(KINDS)}
    what = ", ".join(f"{share:.0%} as {kind}" for kind, share in part.items() if share)
    state.report("stage", {"what": f"hints hold {what} of {len(kinds):,} surfels; training again from {AGAIN:.0%} on"})


def hinted_kinds(state: State, splats: np.ndarray, hints: list[Hint]) -> torch.Tensor:
    """Return what the hints say of each surfel (N,): 0 for metal and 1 for paint, as in `KINDS`, or −1 without a hint.

    `splats` (M, 3) are the positions of the run's splats. Each point of a hint marks the nearest splat. If several hints mark a splat, the
    last one counts. Each surfel takes the mark of the nearest splat, because splats.ply lacks the surfels that no photo shows.
    """
    tree, kinds = cKDTree(splats), np.full(len(splats), -1)
    for hint in hints:
        kinds[tree.query(hint.points)[1]] = KINDS.index(hint.kind)
    nearest = tree.query(state.learned["position"].numpy(force=True))[1]
    return torch.from_numpy(kinds[nearest]).to(state.device)


def _go_back(state: State) -> None:
    """Go back to an earlier iteration, and plan the rest within the time limit."""
    # Without a time limit, AT_MOST minutes become the limit if the rest would take longer. With one, the total is chosen to fill what is
    # left.
    count, pace, plan = (1 - AGAIN) * state.total, state.seconds / max(state.iteration, 1), state.plan
    state.seconds = plan.before = 0.0
    state.clock.resume({}, 0.0)
    if plan.minutes is None and count * pace > 60 * AT_MOST - plan.spent:
        plan.minutes = AT_MOST
    if plan.minutes is not None:
        count = (60 * plan.minutes - plan.spent) / max(pace, 1e-9)
    count = max(round(count), 1)
    state.iteration = round(count * AGAIN / (1 - AGAIN))
    state.total = state.iteration + count


@torch.no_grad()
def _restart(state: State, names: tuple[str, ...], which: torch.Tensor, settings: Settings) -> None:
    """Reset parameters of the surfels where `which` (N,) is true to the initial values."""
    start = start_appearance(settings)
    for name in {*names} & state.learned.keys():
        value, row = state.learned[name], start[name][0]
        # The tensor may lack higher degrees of harmonics.
        value[which] = (row[: value.shape[1]] if row.ndim == 2 else row).to(value)
        state.learned.forget(name, which)
