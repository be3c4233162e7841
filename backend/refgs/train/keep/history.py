"""Record the history of a training in RUN/history.jsonl: one JSON object per line (see docs/run-folder.md)."""

import json
import math
from pathlib import Path

from refgs.errors import reason
from refgs.events import Report
from refgs.formats.history import FILE, damage, read
from refgs.paths import write_text
from refgs.train.keep.checkpoint import DAMAGED, set_aside
from refgs.train.keep.measures import Measures
from refgs.train.keep.progress import Means
from refgs.train.plan import FLIP
from refgs.train.state import State
from refgs.train.timeline import FIRST_LINE

SHARE = 0.025  # part of the training's time that measuring may take; FLIP may take as much again
BESIDE = ("reading", "start", "writing", "measuring", "FLIP")  # parts of the clock that do not count as training time


def allowed(iteration: int, total: int, seconds: float) -> float:
    """Return how many seconds may have been spent on measuring errors before this iteration.

    If measuring has taken longer than this limit, errors are not measured now. `total` is the training's number of iterations, and
    `seconds` is how long it has taken so far.

    At the training's end, the limit is the fraction SHARE of its time. During the training, the limit grows with the logarithm of the
    iteration, because errors are measured at iterations that are evenly spaced by logarithm. The time for the image error FLIP is counted
    separately, and compared with the same limit.
    """
    lines = math.log(max(total / FIRST_LINE, 1)) or 1.0
    passed = min(math.log(max(iteration / FIRST_LINE, 1)) / lines, 1.0)
    return SHARE * passed * seconds * total / iteration


def record(state: State, measures: Measures) -> None:
    """Add a line about the training's present state to the history, and report it as the event "measured".

    Errors against held-out photos and ground truth are measured at the training's end, and earlier if there is time (see `allowed`).
    """
    means = state.part(Means)
    limit = math.inf if state.ended else allowed(state.iteration, state.total, state.seconds)
    parts = dict(state.clock.seconds)
    parts["other"] = state.seconds - sum(value for name, value in parts.items() if name not in BESIDE)
    facts = {"iteration": state.iteration, "seconds": round(state.seconds, 3), "loss": means.loss}
    facts |= {"psnr_train": means.psnr, "splats": state.learned.count}
    for part, measure in (("measuring", measures.errors), ("FLIP", measures.flip)):
        if parts.get(part, 0.0) <= limit and (part != "FLIP" or state.plan.pays_at_end("the image error FLIP", FLIP)):
            with state.clock.part(part):
                facts |= measure(state)
    state.report("measured", dict(facts))
    facts["parts"] = {name: round(value, 4) for name, value in sorted(parts.items())}
    with open(state.folder / FILE, "a", encoding="utf-8") as file:
        file.write(json.dumps(facts) + "\n")


def trim(folder: Path, iteration: int, report: Report) -> None:
    """Remove from the history the lines of iterations after `iteration`, because the training will do these iterations again.

    Damaged lines are removed, too, and reported. If the file cannot be read at all, it is renamed (see `set_aside`), and that is reported.
    """
    file = folder / FILE
    try:
        lines, damaged = read(file)
    except FileNotFoundError:
        return
    except OSError as error:
        set_aside(file)
        report("warning", {"what": f"{file} cannot be read and is set aside as *{DAMAGED}: {reason(error)}"})
        return
    kept = [line for line in lines if (line.get("iteration") or math.inf) <= iteration]
    write_text(file, "".join(json.dumps(line) + "\n" for line in kept))
    if damaged:
        report("warning", {"what": damage(damaged)})
