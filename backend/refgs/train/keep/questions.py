"""Write questions.json: pieces of the surface of which photos do not tell whether they are metal or paint (docs/run-folder.md)."""

import json
import shutil
from pathlib import Path

from torch import Tensor

from refgs.compare.pictures import write_png
from refgs.paths import write_text
from refgs.train.material.questions import Question

FILE, PICTURES = "questions.json", "questions"  # in the run folder


def write_questions(run: Path, questions: list[Question], positions: Tensor, kept: Tensor) -> None:
    """Write questions, each with the positions of its splats and a picture questions/1.png, 2.png …. Remove those of an earlier training.

    `positions` (N, 3) are the surfels'. `kept` (N,) are those that are in splats.ply.
    """
    (run / FILE).unlink(missing_ok=True)
    shutil.rmtree(run / PICTURES, ignore_errors=True)
    rows = []
    for number, question in enumerate(questions, 1):
        file = f"{PICTURES}/{number}.png"
        write_png(run / file, question.picture)
        points = positions[kept & question.members.to(kept.device)].double().round(decimals=5).tolist()
        rows.append({"part": round(question.part, 4), "now": question.now, "picture": file, "points": points})
    if rows:
        write_text(run / FILE, json.dumps({"questions": rows}))
