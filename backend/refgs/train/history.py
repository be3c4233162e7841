"""What a training writes down of itself as it goes: RUN/history.jsonl, an object a line (docs/run-folder.md)."""

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

from refgs.formats.history import FILE, read
from refgs.paths import whole

if TYPE_CHECKING:
    from refgs.train.trainer import Trainer

FIRST = 10  # iterations before the first line
A_DECADE = 10  # lines while iterations grow tenfold: evenly spaced where both axes of a chart are logarithms
SHARE = 0.025  # of the training's time, which measuring may take, and FLIP by itself, which is as dear as all the rest
BESIDE = ("reading", "start", "writing", "measuring", "FLIP")  # parts of the work that are not in a training's seconds


def due(iteration: int) -> bool:
    """Whether an iteration is the first of its place among A_DECADE in a decade. The last one of a training is besides."""
    place, before = (math.floor(A_DECADE * math.log10(max(i, 1))) for i in (iteration, iteration - 1))
    return iteration >= FIRST and place > before


def allowed(iteration: int, total: int, seconds: float) -> float:
    """Seconds that measuring may have taken before this iteration, for none of a chart's lines to have more than its share of what
    all the training is expected to take."""
    lines = math.log(max(total / FIRST, 1)) or 1.0
    passed = min(math.log(max(iteration / FIRST, 1)) / lines, 1.0)
    return SHARE * passed * seconds * total / iteration


def record(trainer: "Trainer", loss: float, quality: float) -> None:
    """Add a line of a training as it is now, with running means of its loss and its PSNR on training views."""
    limit = math.inf if trainer.ended else allowed(trainer.iteration, trainer.total, trainer.seconds)
    parts = dict(trainer.clock.seconds)
    parts["other"] = trainer.seconds - sum(value for name, value in parts.items() if name not in BESIDE)
    facts = {
        "iteration": trainer.iteration,
        "seconds": round(trainer.seconds, 3),
        "loss": loss,
        "psnr_train": quality,
        "splats": len(trainer.parameters["position"]),
    }
    for part, measure in (("measuring", trainer.measures.errors), ("FLIP", trainer.measures.flip)):
        if parts.get(part, 0.0) <= limit:
            with trainer.clock.part(part):
                facts |= measure(trainer)
    trainer.report("measured", dict(facts))
    facts["parts"] = {name: round(value, 4) for name, value in sorted(parts.items())}
    with open(trainer.folder / FILE, "a", encoding="utf-8") as file:
        file.write(json.dumps(facts) + "\n")


def trim(folder: Path, iteration: int) -> None:
    """Forget what is of later iterations than this one: they will be recorded again."""
    file = folder / FILE
    if file.exists():
        kept = [line for line in read(file.read_text(encoding="utf-8")) if line.get("iteration", math.inf) <= iteration]
        with whole(file) as temporary:
            temporary.write_text("".join(json.dumps(line) + "\n" for line in kept), encoding="utf-8")
