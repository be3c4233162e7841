"""Write the page about a batch: a row for each run, with a picture, figures, seconds, and what failed in one line."""

import base64
import os
from pathlib import Path
from typing import NamedTuple

import cv2

from refgs import __version__
from refgs.errors import InputError
from refgs.paths import write_text
from refgs.report.figures import HEADLINE, duration, flatten
from refgs.report.page import template
from refgs.run_folder import run_metrics

PAGE = "index.html"
SIDE = 128  # pixels of a row's picture, so that thousands of rows stay one file that opens
SHOWN = ("psnr", "ssim", "flip", "splats")


class Row(NamedTuple):
    """Hold what the page says of a run. `state` is "done", "failed" or "stopped"; `what` says in one line what failed, as `log` does."""

    name: str
    capture: Path
    state: str
    seconds: float
    what: str = ""
    log: Path | None = None


def write_page(out: Path, rows: list[Row], seconds: float) -> None:
    """Write the page `index.html` about runs in the folder `out`, in place of an earlier one. `seconds` is how long the batch took."""
    metrics = [_figures(out / row.name) for row in rows]
    columns = [quantity for quantity in HEADLINE if quantity.key in SHOWN]
    columns = [quantity for quantity in columns if any(quantity.key in known for known in metrics)]
    table = []
    for row, known in zip(rows, metrics, strict=True):
        figures = [(known.get(q.key), q.text(known[q.key]) if q.key in known else "–") for q in columns]
        table.append(
            {
                "row": row,
                "picture": _picture(out / row.name),
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


def _figures(run: Path) -> dict[str, float]:
    """Read a run's metrics as a flat dict. A broken file counts as none: the run's own report says more."""
    try:
        return dict(flatten(run_metrics(run)))
    except (OSError, ValueError, InputError):
        return {}


def _picture(run: Path) -> str:
    """Return a small picture of a run, as a data URL: its first held-out view as rendered. Return "" if there is none."""
    file = min((run / "pictures" / "test" / "color").glob("*.png"), default=None)
    image = None if file is None else cv2.imread(str(file), cv2.IMREAD_COLOR)
    if image is None:
        return ""
    scale = min(SIDE / max(image.shape[:2]), 1)
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return "data:image/jpeg;base64," + base64.b64encode(cv2.imencode(".jpg", small)[1]).decode()
