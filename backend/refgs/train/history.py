"""Record the history of a training in RUN/history.jsonl, one object a line (docs/run-folder.md)."""

import json
import math
from pathlib import Path

from refgs.formats.history import FILE, read
from refgs.paths import whole
from refgs.train.measures import Measures
from refgs.train.state import State

FIRST = 10  # iterations before the first line
A_DECADE = 10  # lines while iterations grow tenfold: evenly spaced where both axes of a chart are logarithms
SHARE = 0.025  # of the training's time that measuring may take; FLIP, as dear as all else, may take as much again
BESIDE = ("reading", "start", "writing", "measuring", "FLIP")  # parts of the clock that are not in a training's seconds


def due(iteration: int) -> bool:
    """Tell whether to record an iteration.

    While the iteration grows tenfold, A_DECADE iterations are recorded, evenly spaced by logarithm. The trainer also records the last
    iteration.
    """
    place, before = (math.floor(A_DECADE * math.log10(max(i, 1))) for i in (iteration, iteration - 1))
    return iteration >= FIRST and place > before


def allowed(iteration: int, total: int, seconds: float) -> float:
    """Return how many seconds all measurements of errors before this iteration may have taken together. FLIP has the same limit again.

    `seconds` is how long the training took so far. Measuring may take the fraction SHARE of the training's expected time. This time is
    spread evenly over the history's lines, which are evenly spaced by the iteration's logarithm.
    """
    lines = math.log(max(total / FIRST, 1)) or 1.0
    passed = min(math.log(max(iteration / FIRST, 1)) / lines, 1.0)
    return SHARE * passed * seconds * total / iteration


def record(state: State, measures: Measures, loss: float, quality: float) -> None:
    """Add a line that describes the training as it stands.

    `loss` is the running mean of its loss, `quality` that of its PSNR on training views.
    """
    limit = math.inf if state.ended else allowed(state.iteration, state.total, state.seconds)
    parts = dict(state.clock.seconds)
    parts["other"] = state.seconds - sum(value for name, value in parts.items() if name not in BESIDE)
    facts = {
        "iteration": state.iteration,
        "seconds": round(state.seconds, 3),
        "loss": loss,
        "psnr_train": quality,
        "splats": len(state.parameters["position"]),
    }
    for part, measure in (("measuring", measures.errors), ("FLIP", measures.flip)):
        if parts.get(part, 0.0) <= limit:
            with state.clock.part(part):
                facts |= measure(state)
    state.report("measured", dict(facts))
    facts["parts"] = {name: round(value, 4) for name, value in sorted(parts.items())}
    with open(state.folder / FILE, "a", encoding="utf-8") as file:
        file.write(json.dumps(facts) + "\n")


def trim(folder: Path, iteration: int) -> None:
    """Remove the lines of iterations after `iteration`, which will be recorded again."""
    file = folder / FILE
    if file.exists():
        kept = [line for line in read(file.read_text(encoding="utf-8")) if line.get("iteration", math.inf) <= iteration]
        with whole(file) as temporary:
            temporary.write_text("".join(json.dumps(line) + "\n" for line in kept), encoding="utf-8")
