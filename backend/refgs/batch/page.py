"""Write a batch's table: as a page, and as JSON for other programs. Each run has a row with its state, figures and failure."""

import base64
import json
import os
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import cv2

from refgs import __version__
from refgs.errors import InputError
from refgs.formats.pixels import read_png
from refgs.paths import write_text
from refgs.report.figures import HEADLINE, duration, flatten
from refgs.report.page import template
from refgs.run_folder import run_metrics

PAGE = "index.html"
SIDE = 128  # pixels of a row's picture, so that thousands of rows stay one file that opens
SHOWN = ("psnr", "ssim", "flip", "splats")


class Row(NamedTuple):
    """Hold a run's row in the tables.

    `state` is "waiting", "running", "done", "failed" or "stopped". A running run is at the step `step`. `part`, 0 … 1, is how much of this
    step is done; it is None if that is not known. `what` says in one line what failed, and `log` is the file that says more. `figures` are
    the run's metrics, and `picture` is its first held-out view as rendered.
    """

    name: str
    capture: Path
    state: str
    seconds: float
    what: str
    log: Path | None
    step: str
    part: float | None
    figures: dict[str, float]
    picture: Path | None


def write_rows(file: Path, rows: list[Row]) -> None:
    """Write the rows to `file` as JSON (see docs/batch.md), ignoring a failed write."""
    facts = []
    for row in rows:
        figures = {key: row.figures[key] for key in SHOWN if key in row.figures}
        facts.append(row._asdict() | {"figures": figures})
    with suppress(OSError):  # a reader that has the file open on Windows, or a full disk, must not end the batch
        write_text(file, json.dumps({"rows": facts}, default=str), durable=False)


def write_page(out: Path, rows: list[Row], seconds: float) -> None:
    """Write the page `index.html` into `out`, about a batch that took `seconds`."""
    columns = [quantity for quantity in HEADLINE if quantity.key in SHOWN]
    columns = [quantity for quantity in columns if any(quantity.key in row.figures for row in rows)]
    table = []
    for row in rows:
        known = row.figures
        figures = [(known.get(q.key), q.text(known[q.key]) if q.key in known else "–") for q in columns]
        table.append(
            {
                "row": row,
                "picture": _small(row.picture),
                "figures": figures,
                "seconds": duration(row.seconds),
                "link": row.name if (out / row.name).is_dir() else None,
                "log": Path(os.path.relpath(row.log, out)).as_posix() if row.log else None,
            }
        )
    states = {state: sum(row.state == state for row in rows) for state in ("done", "failed", "stopped")}
    text = template(Path(__file__).with_name("batch.html")).render(
        name=out.resolve().name,
        version=__version__,
        columns=[quantity.heading for quantity in columns],
        table=table,
        states={state: count for state, count in states.items() if count},
        seconds=duration(seconds),
    )
    write_text(out / PAGE, text)


def figures_of(run: Path) -> dict[str, float]:
    """Return a run's metrics as a flat dict, {} if they cannot be read."""
    try:
        return dict(flatten(run_metrics(run)))
    except (OSError, ValueError, InputError):
        return {}


def picture_of(run: Path) -> Path | None:
    """Return the file of a run's first rendered held-out view, or None."""
    return min((run / "pictures" / "test" / "color").glob("*.png"), default=None)


def _small(file: Path | None) -> str:
    """Return a picture as a data URL of SIDE pixels, "" if there is none."""
    image = None if file is None else read_png(file, cv2.IMREAD_COLOR)
    if image is None:
        return ""
    scale = min(SIDE / max(image.shape[:2]), 1)
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return "data:image/jpeg;base64," + base64.b64encode(cv2.imencode(".jpg", small)[1].tobytes()).decode()
